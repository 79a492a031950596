"""Corrects what other clients publish on the bridge's topics, with growing pauses.

Without pauses, two bridges with the same prefix would correct each other without end. So would
brokers that return each other's messages.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from itertools import islice
from typing import Final, Protocol

from shmio.backoff import Backoff

AT_ONCE: Final = 200
"""Maximum number of topics that are corrected together."""
PAUSE: Final = Backoff(0.1, 5.0)
"""Pauses between corrections. They grow while other clients publish on the bridge's topics."""
CALM_PAUSES: Final = 4
"""Number of pauses without a correction after which pauses are short again."""
CALM_S: Final = 60.0
"""Time in s without a break after which the next break is short again."""
MOST_WAITING: Final = 1000
"""Maximum number of topics that wait for a correction. If there are more, all topics are published again."""
MAX_FOREIGN_MESSAGES: Final = 2000
"""Number of messages of other clients within one second above which the guard takes a break.

During the break, it corrects nothing.
"""
BREAK: Final = Backoff(10.0, 320.0)
"""Durations of the breaks. They grow while other clients publish on the bridge's topics."""

log = logging.getLogger("shmio.mqtt")


class TopicOwner(Protocol):
    """What the guard needs of the bridge."""

    def watch(self) -> None:
        """Subscribe to the bridge's own topics, to notice what other clients publish on them."""

    def unwatch(self) -> None:
        """Unsubscribe from the bridge's own topics."""

    def correct(self, topic: str) -> None:
        """Publish the bridge's value on a topic again."""

    def correct_all(self) -> None:
        """Publish the present state of all topics again."""


class TopicGuard:
    """Decides which topics to correct, and when. Use it only in the bridge's thread."""

    def __init__(self, owner: TopicOwner, now_s: Callable[[], float] = time.monotonic) -> None:
        self._owner, self._now_s = owner, now_s
        self._waiting: dict[str, None] = {}
        self._everything = False
        self._pauses = self._breaks = 0
        """Numbers of consecutive pauses and breaks. Each is longer than the previous."""
        self._due_s = self._until_s = self._second_s = 0.0
        self._count = 0
        self._on_break = False

    def begin(self) -> None:
        """Start to watch, after a connect. Waiting corrections are dropped: the bridge publishes all topics then."""
        if not self._on_break:
            self._waiting.clear()
            self._everything = False
            self._owner.watch()

    def report(self, topic: str) -> None:
        """Record that another client has published a wrong value on a topic."""
        if self._on_break:  # sent before we unsubscribed
            return
        now_s = self._now_s()
        if now_s - self._second_s >= 1.0:
            self._second_s, self._count = now_s, 0
        self._count += 1
        if self._count > MAX_FOREIGN_MESSAGES:
            self._owner.unwatch()
            self._waiting.clear()
            if now_s >= self._until_s + CALM_S:
                self._breaks = 0
            break_s = BREAK.wait_s(self._breaks)
            self._breaks += 1
            self._on_break, self._everything, self._until_s = True, True, now_s + break_s
            log.warning(
                "other clients publish too much on this instance's topics; the bridge does not correct them for %g s",
                break_s,
            )
        elif topic not in self._waiting and len(self._waiting) >= MOST_WAITING:
            self._everything = True
        else:
            self._waiting[topic] = None

    def run_once(self) -> float:
        """Correct the topics that are due. Return the time in s after which to call this method again."""
        now_s = self._now_s()
        if self._on_break:
            if now_s < self._until_s:
                return self._until_s - now_s
            self._on_break = False
            self._owner.watch()
        if not (self._waiting or self._everything):
            return CALM_S
        if now_s < self._due_s:
            return self._due_s - now_s
        if now_s >= self._due_s + CALM_PAUSES * PAUSE.wait_s(self._pauses):
            self._pauses = 0
        self._correct()
        self._due_s = now_s + PAUSE.wait_s(self._pauses)
        self._pauses += 1
        return self._due_s - now_s if self._waiting else CALM_S

    def _correct(self) -> None:
        if self._everything:
            self._everything = False
            self._waiting.clear()
            self._owner.correct_all()
            return
        for topic in list(islice(self._waiting, AT_ONCE)):
            del self._waiting[topic]
            self._owner.correct(topic)
