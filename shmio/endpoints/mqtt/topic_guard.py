"""What others publish on the bridge's topics is corrected at once; within bounds, so that nobody is answered for ever.

Two bridges of one prefix, or brokers that hand each other's messages back, would else correct each other without end.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from itertools import islice
from typing import Final, Protocol

AT_ONCE: Final = 200
"""Topics that are corrected together."""
FIRST_PAUSE_S: Final = 0.1
"""Between two corrections; twice as long after each, as long as others go on."""
MOST_PAUSE_S: Final = 5.0
CALM_PAUSES: Final = 4
"""After so many pauses without a correction the next one is as the first."""
CALM_S: Final = 60.0
"""The same for rests: so long without another."""
MOST_WAITING: Final = 1000
"""Topics that wait for it; beyond that everything is told again."""
MOST_HEARD: Final = 2000
"""Messages of others in a second; then none is heard for a while."""
REST_S: Final = 10.0
MOST_REST_S: Final = 320.0

log = logging.getLogger("shmio.mqtt")


class TopicOwner(Protocol):
    """Whose topics they are."""

    def watch(self) -> None:
        """Hear what others publish there."""

    def unwatch(self) -> None:
        """Hear it no more."""

    def correct(self, topic: str) -> None:
        """Tell again what is so."""

    def correct_all(self) -> None:
        """Tell again everything."""


class TopicGuard:
    """For the bridge's thread."""

    def __init__(self, owner: TopicOwner, now_s: Callable[[], float] = time.monotonic) -> None:
        self._owner, self._now_s = owner, now_s
        self._waiting: dict[str, None] = {}
        self._everything = False
        self._pause_s, self._rest_s = FIRST_PAUSE_S, REST_S
        self._due_s = self._until_s = self._second_s = 0.0
        self._count = 0
        self._resting = False

    def begin(self) -> None:
        """There is a connection, and everything is being told: hear what others say from now on."""
        if not self._resting:
            self._waiting.clear()
            self._everything = False
            self._owner.watch()

    def report(self, topic: str) -> None:
        """Somebody else has published there what is not so."""
        if self._resting:  # it was under way
            return
        now_s = self._now_s()
        if now_s - self._second_s >= 1.0:
            self._second_s, self._count = now_s, 0
        self._count += 1
        if self._count > MOST_HEARD:
            self._owner.unwatch()
            self._waiting.clear()
            if now_s >= self._until_s + CALM_S:
                self._rest_s = REST_S
            self._resting, self._everything, self._until_s = True, True, now_s + self._rest_s
            log.warning("others publish too much on our topics: none of it is corrected for %g s", self._rest_s)
            self._rest_s = min(2 * self._rest_s, MOST_REST_S)
        elif topic not in self._waiting and len(self._waiting) >= MOST_WAITING:
            self._everything = True
        else:
            self._waiting[topic] = None

    def turn(self) -> float:
        """Correct what is due; in how many seconds there is more."""
        now_s = self._now_s()
        if self._resting:
            if now_s < self._until_s:
                return self._until_s - now_s
            self._resting = False
            self._owner.watch()
        if not (self._waiting or self._everything):
            return CALM_S
        if now_s < self._due_s:
            return self._due_s - now_s
        if now_s >= self._due_s + CALM_PAUSES * self._pause_s:
            self._pause_s = FIRST_PAUSE_S
        self._correct()
        self._due_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, MOST_PAUSE_S)
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
