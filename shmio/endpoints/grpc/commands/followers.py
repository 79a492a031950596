"""Who has laid injections on one block, or listens to what is written to it, and what concerns them of its events."""

from __future__ import annotations

from typing import Final, Protocol

from shmio.segment import Event, EventKind
from shmio.segment.pending_commands import Diverted, Gatherer

_STACKED: Final = frozenset({EventKind.INJECTED, EventKind.LIFTED, EventKind.ACTIVATED, EventKind.DEACTIVATED})


class Follower:
    """Who has laid an injection, and overrides what concerns him; called in the event loop's thread."""

    def happened(self, event: Event) -> None:
        """It was laid, has become active, is no longer, or was lifted."""

    def divert(self, diverted: Diverted) -> None:
        """A command's values went to it."""

    def restack(self) -> None:
        """An injection was laid or lifted, became active or is no longer, on the same source."""

    def lifted(self, reason: str) -> None:
        """It was lifted."""

    def fail(self, reason: str) -> None:
        """What comes next is not all there was."""


class Listener(Protocol):
    """Who listens to what is written; called in the event loop's thread."""

    def accept(self, event: Event) -> None:
        """The source has accepted this part of a command."""

    def fail(self, reason: str) -> None:
        """What comes next is not all there was."""


News = Diverted | Event
"""What was diverted, or happened to injections; what was accepted, if somebody listens."""


class Followers:
    """By the number of their injection."""

    def __init__(self) -> None:
        self._followers: dict[int, Follower] = {}
        self._listeners: dict[Listener, None] = {}  # in the order in which they came
        self._gatherer = Gatherer()

    def gather(self, event: Event) -> list[News]:
        """What is to be told by this event."""
        news: list[News] = [*self._gatherer.follow(event)]
        if (event.kind in _STACKED and not event.offset) or (event.kind == EventKind.ACCEPTED and self._listeners):
            news.append(event)  # of a long declaration's parts the first
        return news

    def skip(self) -> None:
        """Events were missed."""
        self._gatherer = Gatherer()

    def add(self, injection: int, follower: Follower) -> None:
        """Tell it from now on; before any of its events can have come."""
        self._followers[injection] = follower

    def remove(self, injection: int) -> None:
        """Tell it nothing more."""
        self._followers.pop(injection, None)

    def listen(self, listener: Listener) -> None:
        """Tell it what is accepted from now on."""
        self._listeners[listener] = None

    def leave(self, listener: Listener) -> None:
        """Tell it nothing more."""
        self._listeners.pop(listener, None)

    @property
    def busy(self) -> bool:
        """Whether anybody listens to what is written."""
        return bool(self._listeners)

    def tell(self, news: News) -> None:
        """Tell those whom it concerns."""
        if isinstance(news, Diverted):
            if follower := self._followers.get(news.injection):
                follower.divert(news)
            return
        if news.kind == EventKind.ACCEPTED:
            for listener in list(self._listeners):
                listener.accept(news)
            return
        if follower := self._followers.get(news.injection):
            follower.happened(news)
            if news.kind == EventKind.LIFTED:
                del self._followers[news.injection]
                follower.lifted(news.text)
        if news.kind in _STACKED:
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
