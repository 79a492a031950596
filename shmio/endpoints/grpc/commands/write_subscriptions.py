"""What is written to registers, for those who listen to their ``/in``."""

from __future__ import annotations

from collections.abc import Callable, Sized
from typing import Final, NamedTuple, Protocol

from shmio.endpoints.grpc.commands.pending_image import PendingImage
from shmio.endpoints.grpc.streams.subject import Subject
from shmio.layout.values.write import covering
from shmio.segment import Block, Event, EventKind


class Listener(Protocol):
    """One stream; called in the event loop's thread."""

    def deliver(self, message: Sized) -> None:
        """Take one message for this stream."""

    def fail(self, reason: str) -> None:
        """End: what comes next is not all there was."""


class InChannel:
    """A subject as somebody listens to its ``/in``."""

    def __init__(self, subject: Subject) -> None:
        self.encode = subject.encode
        self.listeners: dict[Listener, None] = {}  # in the order in which they came
        self.start = min(register.offset for register in subject.registers)
        self.stop = max(register.offset + register.size for register in subject.registers)
        self.bits = int.from_bytes(covering(subject.registers, self.stop), "big")


Message = tuple[InChannel, Sized]


class _Written(NamedTuple):
    """A :class:`BlockImage` of a block as it will be."""

    number: int
    clock_ns: int
    image: bytes


_NOBODY: Final = (0, 0, 0)


class WriteSubscriptions:
    """Turns accepted writes of all writers into messages, in the order in which the source accepted them.

    A subject is shown when a command has written all of it. One of which only a part is written, as an array's
    element, is shown when that is known to be all, with the rest as of the frame before the command. A command whose
    first events nobody followed is passed over: it could only be shown in part.
    """

    def __init__(self, block: Block, stamp: Callable[[Event], tuple[int, int]]) -> None:
        """``stamp``: number and time, ns of the instance's clock, of the message about an event."""
        self._block = block
        self._stamp = stamp
        self._channels: dict[Subject, InChannel] = {}
        self._table: tuple[InChannel, ...] = ()
        self._pending_image = PendingImage(block)
        self._command = _NOBODY  # the one accepted last; it is not known at first, nor after a gap
        self._whole = False  # whether all of it so far has been put
        self._partly: dict[InChannel, Event] = {}  # channels it has written a part of

    def listen(self, subject: Subject, listener: Listener) -> None:
        """Join: what is accepted from now on is delivered."""
        channel = self._channels.get(subject)
        if channel is None:
            channel = self._channels[subject] = InChannel(subject)
            self._table = tuple(self._channels.values())
        channel.listeners[listener] = None

    def leave(self, subject: Subject, listener: Listener) -> None:
        """Leave; the last listener takes the channel with it."""
        channel = self._channels[subject]
        channel.listeners.pop(listener, None)
        if not channel.listeners:
            del self._channels[subject]
            self._table = tuple(self._channels.values())

    @property
    def busy(self) -> bool:
        """Whether anybody listens."""
        return bool(self._channels)

    def fail(self, reason: str) -> None:
        """End all streams."""
        for channel in self._table:
            for listener in channel.listeners:
                listener.fail(reason)

    def skip(self) -> None:
        """Events were missed: what is known of the command they may have belonged to is worth nothing."""
        self._command, self._whole = _NOBODY, False
        self._pending_image.forget()
        self._partly.clear()

    def follow(self, event: Event) -> list[Message]:
        """The messages that an event gives rise to."""
        command = _command(event)
        if event.kind != EventKind.ACCEPTED:
            # Ends of commands before it may come between the parts of one.
            return self._rest() if command == self._command or event.kind == EventKind.STARTED else []
        messages: list[Message] = []
        table = self._table
        if command != self._command:
            messages = self._rest()
            self._whole = bool(table) and (self._command != _NOBODY or self._begins(event))
            self._command = command
            if self._whole:
                self._pending_image.begin(event.frame)
        if not table:
            self._whole = False
            self._pending_image.forget()
        if not self._whole:
            return messages
        self._pending_image.put(event)
        for channel in table:
            if channel.start < event.offset + len(event.data) and event.offset < channel.stop:
                self._touch(channel, event, messages)
        return messages

    def _begins(self, event: Event) -> bool:
        """Whether it is surely the first of its command, by the events before it."""
        for number in range(event.number - 1, 0, -1):
            before = self._block.events.read(number)
            if before is None:
                return False
            if before.kind == EventKind.ACCEPTED:
                return _command(before) != _command(event)
        return True

    def _touch(self, channel: InChannel, event: Event, messages: list[Message]) -> None:
        """Show a channel when the last of its bits is written; what remains in part is shown by :meth:`_rest`."""
        bits = int.from_bytes(event.mask.to_bytes(1, "big") if event.mask else b"\xff" * len(event.data), "big")
        shift = 8 * (channel.stop - event.offset - len(event.data))
        if not (bits << shift if shift >= 0 else bits >> -shift) & channel.bits:
            return  # other bits of its bytes
        if channel.bits & ~int.from_bytes(self._pending_image.mask[channel.start : channel.stop], "big"):
            self._partly[channel] = event
            return
        self._partly.pop(channel, None)
        self._show(channel, event, messages)

    def _rest(self) -> list[Message]:
        """The channels of which the command has written a part: it is over when something else is told."""
        messages: list[Message] = []
        for channel, event in self._partly.items():
            self._show(channel, event, messages)
        self._partly.clear()
        return messages

    def _show(self, channel: InChannel, event: Event, messages: list[Message]) -> None:
        message = channel.encode(_Written(*self._stamp(event), bytes(self._pending_image.image)))
        if message is not None:
            messages.append((channel, message))


def _command(event: Event) -> tuple[int, int, int]:
    return event.incarnation, event.writer, event.command
