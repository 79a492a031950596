"""Delivers accepted writes to clients that have subscribed to the ``/in`` of registers."""

from __future__ import annotations

from collections.abc import Callable, Sized
from typing import Protocol

from shmio.endpoints.grpc.encoding import ShownImage, Subject
from shmio.layout.values.write import Write, covering
from shmio.segment import Block, Event, EventKind
from shmio.segment.commands import NO_COMMAND, apply


class PendingImage:
    """The image of a frame with the effects of all commands that were accepted after that frame.

    In ``mask``, the bits that the current command has written are set.
    """

    def __init__(self, block: Block) -> None:
        self.image = bytearray(block.layout.size)
        self.mask = bytearray(block.layout.size)
        self._block = block
        self._frame = -1

    def begin(self, number: int) -> None:
        """Start a command that was accepted after frame ``number``.

        The image stays based on this frame, even if a new frame arrives between the parts of the
        command.
        """
        if number != self._frame:
            frame = self._block.read(number) or self._block.latest()
            self._frame = number
            self.image = bytearray(len(self.image)) if frame is None else bytearray(frame.image)
            if (statuses := self._block.layout.status_offset) is not None:
                self.image[statuses:] = bytes(len(self.image) - statuses)  # a written value is good
        self.mask = bytearray(len(self.mask))

    def put(self, event: Event) -> None:
        """Apply one part of the command."""
        apply(self.image, (Write(event.offset, event.mask, event.data),))
        apply(self.mask, (ones(event),))

    def forget(self) -> None:
        """Discard the image, because a part of the command is missing."""
        self._frame = -1


def ones(event: Event) -> Write:
    """Return a write that sets each bit that this part of a command writes."""
    return Write(event.offset, event.mask, b"\xff" * len(event.data))


class Listener(Protocol):
    """A stream's subscription to writes. The methods are called in the event loop's thread."""

    def deliver(self, message: Sized) -> None:
        """Add one message to the stream."""

    def fail(self, reason: str) -> None:
        """End the stream, because writes were missed."""


class InChannel:
    """A subject whose ``/in`` has listeners."""

    def __init__(self, subject: Subject) -> None:
        self.encode = subject.encode
        self.listeners: dict[Listener, None] = {}  # in the order in which they came
        self.start = min(register.offset for register in subject.registers)
        self.stop = max(register.offset + register.size for register in subject.registers)
        self.bits = int.from_bytes(covering(subject.registers, self.stop), "big")


Message = tuple[InChannel, Sized]


class WriteSubscriptions:
    """Turns the accepted writes of all writers into messages, in the order of acceptance.

    A subject's message is delivered as soon as a command has written the whole subject. If a
    command writes only a part, such as one array element, the message is delivered at the end of
    the command. The rest of the value then comes from the frame before the command. A command whose
    first events were missed is skipped.
    """

    def __init__(self, block: Block, stamp: Callable[[Event], tuple[int, int]]) -> None:
        """Start without listeners.

        Args:
            block: The block that is written to.
            stamp: Returns an event's number, and its time in ns of the instance's clock.

        """
        self._block = block
        self._stamp = stamp
        self._channels: dict[Subject, InChannel] = {}
        self._table: tuple[InChannel, ...] = ()
        self._pending_image = PendingImage(block)
        self._command = NO_COMMAND  # the last accepted command; unknown at first and after missed events
        self._whole = False  # whether all parts of the command so far were applied
        self._partly: dict[InChannel, Event] = {}  # channels that the command has written in part

    def listen(self, subject: Subject, listener: Listener) -> None:
        """Add a listener to the writes that are accepted from now on."""
        channel = self._channels.get(subject)
        if channel is None:
            channel = self._channels[subject] = InChannel(subject)
            self._table = tuple(self._channels.values())
        channel.listeners[listener] = None

    def leave(self, subject: Subject, listener: Listener) -> None:
        """Remove a listener. If it was the last listener to the subject, the channel ends."""
        channel = self._channels[subject]
        channel.listeners.pop(listener, None)
        if not channel.listeners:
            del self._channels[subject]
            self._table = tuple(self._channels.values())

    @property
    def busy(self) -> bool:
        """True if there are listeners."""
        return bool(self._channels)

    def fail(self, reason: str) -> None:
        """End the streams of all listeners, because writes were missed."""
        for channel in self._table:
            for listener in channel.listeners:
                listener.fail(reason)

    def skip(self) -> None:
        """Discard the current command, because events were missed."""
        self._command, self._whole = NO_COMMAND, False
        self._pending_image.forget()
        self._partly.clear()

    def follow(self, event: Event) -> list[Message]:
        """Process an event, and return the messages to deliver."""
        command = event.command_key
        if event.kind != EventKind.ACCEPTED:
            # Outcomes of earlier commands may arrive between the parts of this one.
            return self._rest() if command == self._command or event.kind == EventKind.STARTED else []
        messages: list[Message] = []
        table = self._table
        if command != self._command:
            messages = self._rest()
            self._whole = bool(table) and (self._command != NO_COMMAND or self._begins(event))
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
        """Return whether the previous events prove that this is the first event of its command."""
        for number in range(event.number - 1, 0, -1):
            before = self._block.events.read(number)
            if before is None:
                return False
            if before.kind == EventKind.ACCEPTED:
                return before.command_key != event.command_key
        return True

    def _touch(self, channel: InChannel, event: Event, messages: list[Message]) -> None:
        """Add the message of a channel if the command has written all its bits.

        :meth:`_rest` adds the message of a channel that is written only in part.
        """
        bits = int.from_bytes(event.mask.to_bytes(1, "big") if event.mask else b"\xff" * len(event.data), "big")
        shift = 8 * (channel.stop - event.offset - len(event.data))
        if not (bits << shift if shift >= 0 else bits >> -shift) & channel.bits:
            return  # the write changes other bits of the same bytes
        if channel.bits & ~int.from_bytes(self._pending_image.mask[channel.start : channel.stop], "big"):
            self._partly[channel] = event
            return
        self._partly.pop(channel, None)
        self._show(channel, event, messages)

    def _rest(self) -> list[Message]:
        """Return the messages of channels that the finished command has written only in part."""
        messages: list[Message] = []
        for channel, event in self._partly.items():
            self._show(channel, event, messages)
        self._partly.clear()
        return messages

    def _show(self, channel: InChannel, event: Event, messages: list[Message]) -> None:
        message = channel.encode(ShownImage(*self._stamp(event), bytes(self._pending_image.image)))
        if message is not None:
            messages.append((channel, message))
