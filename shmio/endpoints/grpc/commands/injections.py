"""Injections on one block: their followers, and the images whose values they replace."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Protocol

import numpy as np

from shmio.layout.values.write import Write
from shmio.segment import Block, Event, EventKind
from shmio.segment.commands import CommandAssembler, CommandWrites, apply

_STACKED: Final = frozenset({EventKind.INJECTED, EventKind.LIFTED, EventKind.ACTIVATED, EventKind.DEACTIVATED})


class InjectionFollower:
    """Receives the events of one injection. Subclasses override the methods that they need.

    The methods are called in the event loop's thread.
    """

    def on_event(self, event: Event) -> None:
        """Handle an event: the injection was created, activated, deactivated or lifted."""

    def divert(self, diverted: CommandWrites) -> None:
        """Handle a command whose values were diverted to the injection."""

    def restack(self) -> None:
        """Handle a change of the source's injections.

        Any of them, this one included, was created, lifted, activated or deactivated. Not called
        after this one was lifted.
        """

    def lifted(self, reason: str) -> None:
        """Handle the injection's end.

        Args:
            reason: Why the injection was lifted.

        """

    def fail(self, reason: str) -> None:
        """Handle the loss of events, some of which may have been about the injection."""


class WriteListener(Protocol):
    """Receives accepted writes. The methods are called in the event loop's thread."""

    def accept(self, event: Event) -> None:
        """Handle an event with accepted writes: one part of a command."""

    def fail(self, reason: str) -> None:
        """Handle the loss of events: some writes are missing."""


class InjectionFollowers:
    """The followers of a block's injections, and the listeners to the block's writes."""

    def __init__(self) -> None:
        self._followers: dict[int, InjectionFollower] = {}
        self._listeners: dict[WriteListener, None] = {}  # in the order in which they came
        self._assembler = CommandAssembler()

    def follow(self, event: Event) -> None:
        """Pass an event to the followers and listeners that need it."""
        for diverted in self._assembler.follow(event):
            if follower := self._followers.get(diverted.injection):
                follower.divert(diverted)
        if event.kind == EventKind.ACCEPTED:
            for listener in list(self._listeners):
                listener.accept(event)
        elif event.kind in _STACKED and not event.offset:  # only the first part of a long declaration
            if follower := self._followers.get(event.injection):
                follower.on_event(event)
                if event.kind == EventKind.LIFTED:
                    del self._followers[event.injection]
                    follower.lifted(event.text)
            for follower in list(self._followers.values()):
                follower.restack()

    def skip(self) -> None:
        """Forget the command that is incomplete because events were missed."""
        self._assembler = CommandAssembler()

    def add(self, injection: int, follower: InjectionFollower) -> None:
        """Add an injection's follower. Call this before the injection's first event can come."""
        self._followers[injection] = follower

    def remove(self, injection: int) -> None:
        """Remove an injection's follower."""
        self._followers.pop(injection, None)

    def listen(self, listener: WriteListener) -> None:
        """Add a listener to the writes that are accepted from now on."""
        self._listeners[listener] = None

    def leave(self, listener: WriteListener) -> None:
        """Remove a listener to writes."""
        self._listeners.pop(listener, None)

    @property
    def idle(self) -> bool:
        """True if there are no followers and no listeners."""
        return not (self._followers or self._listeners)

    @property
    def busy(self) -> bool:
        """True if somebody listens to writes."""
        return bool(self._listeners)

    def fail(self, reason: str) -> None:
        """Report the loss of events to all followers and listeners."""
        for follower in list(self._followers.values()):
            follower.fail(reason)
        for listener in list(self._listeners):
            listener.fail(reason)

    def end(self, reason: str) -> None:
        """Report to all followers that their injections have ended."""
        followers, self._followers = self._followers, {}
        for follower in followers.values():
            follower.lifted(reason)


class InjectionBase:
    """The image whose values an injection replaces: the source's image with all inner injections applied."""

    def __init__(self, block: Block, image: bytes = b"") -> None:
        """Start without inner injections.

        Args:
            block: The block of the injection.
            image: Initial values of the inner injections, as an image; zeros if empty.

        """
        self.number = 0
        """The injection's number; 0 until the number is known."""
        self.given = bytearray(image or bytes(block.layout.size))
        """The values that were diverted to the injection so far, as an image."""
        if (statuses := block.layout.status_offset) is not None:
            self.given[statuses:] = bytes(len(self.given) - statuses)  # a diverted value is good
        self._block = block
        self._inner: tuple[bytes, bytes] | None = None  # bits that inner layers set, and their values

    def divert(self, writes: Iterable[Write]) -> None:
        """Apply values that were diverted to the injection: by inner injections, or over ``/in`` from writers."""
        apply(self.given, writes)

    def restack(self) -> bool:
        """Read again which inner injections are active.

        Returns:
            True if that changes the image which the injection replaces.

        """
        before = self._inner
        bits = np.zeros(len(self.given), np.uint8)
        for one in self._block.injections.read() if self.number else ():
            if one.number == self.number:
                break
            if one.direction == "out" and one.active:
                for offset, size, mask in one.ranges:
                    bits[offset : offset + size] |= mask
        self._inner = (bits.tobytes(), bytes(self.given)) if bits.any() else None
        return self._inner != before

    def image(self, raw: bytes) -> bytes:
        """Return the image whose values the injection replaces.

        Args:
            raw: The image as the source delivered it.

        """
        inner = self._inner
        if inner is None:
            return raw
        delivered, bits, values = (np.frombuffer(part, np.uint8) for part in (raw, *inner))
        return (delivered ^ (delivered ^ values) & bits).tobytes()
