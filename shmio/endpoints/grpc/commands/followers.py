"""Who has laid injections on one block, or listens to what is written to it, and what concerns them of its events."""

from __future__ import annotations

from typing import Final, Protocol

from shmio.segment import Event, EventKind
from shmio.segment.pending_commands import CommandAssembler, CommandWrites

_STACKED: Final = frozenset({EventKind.INJECTED, EventKind.LIFTED, EventKind.ACTIVATED, EventKind.DEACTIVATED})


class InjectionFollower:
    """Who has laid an injection, and overrides what concerns him; called in the event loop's thread."""

    def happened(self, event: Event) -> None:
        """It was laid, has become active, is no longer, or was lifted."""

    def divert(self, diverted: CommandWrites) -> None:
        """A command's values went to it."""

    def restack(self) -> None:
        """An injection was laid or lifted, became active or is no longer, on the same source."""

    def lifted(self, reason: str) -> None:
        """It was lifted."""

    def fail(self, reason: str) -> None:
        """What comes next is not all there was."""


class WriteListener(Protocol):
    """Who listens to what is written; called in the event loop's thread."""

    def accept(self, event: Event) -> None:
        """The source has accepted this part of a command."""

    def fail(self, reason: str) -> None:
        """What comes next is not all there was."""


InjectionChange = CommandWrites | Event
"""What was diverted, or happened to injections; what was accepted, if somebody listens."""


class InjectionFollowers:
    """By the number of their injection."""

    def __init__(self) -> None:
        self._followers: dict[int, InjectionFollower] = {}
        self._listeners: dict[WriteListener, None] = {}  # in the order in which they came
        self._assembler = CommandAssembler()

    def gather(self, event: Event) -> list[InjectionChange]:
        """What is to be told by this event."""
        change: list[InjectionChange] = [*self._assembler.follow(event)]
        if (event.kind in _STACKED and not event.offset) or (event.kind == EventKind.ACCEPTED and self._listeners):
            change.append(event)  # of a long declaration's parts the first
        return change

    def skip(self) -> None:
        """Events were missed."""
        self._assembler = CommandAssembler()

    def add(self, injection: int, follower: InjectionFollower) -> None:
        """Tell it from now on; before any of its events can have come."""
        self._followers[injection] = follower

    def remove(self, injection: int) -> None:
        """Tell it nothing more."""
        self._followers.pop(injection, None)

    def listen(self, listener: WriteListener) -> None:
        """Tell it what is accepted from now on."""
        self._listeners[listener] = None

    def leave(self, listener: WriteListener) -> None:
        """Tell it nothing more."""
        self._listeners.pop(listener, None)

    @property
    def busy(self) -> bool:
        """Whether anybody listens to what is written."""
        return bool(self._listeners)

    def tell(self, change: InjectionChange) -> None:
        """Tell those whom it concerns."""
        if isinstance(change, CommandWrites):
            if follower := self._followers.get(change.injection):
                follower.divert(change)
            return
        if change.kind == EventKind.ACCEPTED:
            for listener in list(self._listeners):
                listener.accept(change)
            return
        if follower := self._followers.get(change.injection):
            follower.happened(change)
            if change.kind == EventKind.LIFTED:
                del self._followers[change.injection]
                follower.lifted(change.text)
        if change.kind in _STACKED:
            for follower in list(self._followers.values()):
                follower.restack()

    def fail(self, reason: str) -> None:
        """Tell all that something was missed."""
        for follower in list(self._followers.values()):
            follower.fail(reason)
        for listener in list(self._listeners):
            listener.fail(reason)

    def end(self, reason: str) -> None:
        """All injections are gone."""
        followers, self._followers = self._followers, {}
        for follower in followers.values():
            follower.lifted(reason)
