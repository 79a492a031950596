"""Who has laid injections on one block, and what concerns them of its events."""

from __future__ import annotations

from typing import Protocol

from shmio.segment import Event, EventKind
from shmio.segment.diverted import Diverted, Gatherer


class Follower(Protocol):
    """Who has laid an injection; called in the event loop's thread."""

    def divert(self, diverted: Diverted) -> None:
        """A command's values went to it."""

    def restack(self) -> None:
        """An injection was laid or lifted, on the same source."""

    def lifted(self, reason: str) -> None:
        """It was lifted."""

    def fail(self, reason: str) -> None:
        """What comes next is not all there was."""


News = Diverted | Event
"""What was diverted, or that an injection was laid or lifted."""


class Followers:
    """By the number of their injection."""

    def __init__(self) -> None:
        self._followers: dict[int, Follower] = {}
        self._gatherer = Gatherer()

    def gather(self, event: Event) -> list[News]:
        """What is to be told by this event."""
        news: list[News] = [*self._gatherer.follow(event)]
        if event.kind in (EventKind.INJECTED, EventKind.LIFTED):
            news.append(event)
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

    def tell(self, news: News) -> None:
        """Tell those whom it concerns."""
        if isinstance(news, Diverted):
            if follower := self._followers.get(news.injection):
                follower.divert(news)
            return
        if news.kind == EventKind.LIFTED and (follower := self._followers.pop(news.injection, None)):
            follower.lifted(news.text)
        for follower in list(self._followers.values()):
            follower.restack()

    def fail(self, reason: str) -> None:
        """Tell all that something was missed."""
        for follower in list(self._followers.values()):
            follower.fail(reason)

    def end(self, reason: str) -> None:
        """All injections are gone."""
        followers, self._followers = self._followers, {}
        for follower in followers.values():
            follower.lifted(reason)
