"""Whether a client takes what there is for it, or at least most of it."""

from __future__ import annotations

from typing import Final

WINDOW_S: Final = 0.25
"""So often it is looked at."""
BEHIND_S: Final = 5.0
"""At the next multiple of this one that is far behind is tried again, for what it loses meanwhile does not say how fast
it is: with all others, for what is read for one of them is there for all."""
PART: Final = 3
"""A client that has lost more than one in so many values is far behind."""
LATE_S: Final = 0.002
"""What is for one that is far behind waits no longer if there is something newer."""


class Pace:
    """Of one client's stream. Times in s, on any clock."""

    def __init__(self) -> None:
        self.behind = False
        """Whether it is far behind: then what waits for it makes it no better off, only later."""
        self._offered = 0
        self._lost = 0
        self._until_s = 0.0

    def offer(self, now_s: float) -> None:
        """There is a value for it."""
        if now_s >= self._until_s:
            self.behind = not self.behind and PART * self._lost > self._offered
            self._offered = self._lost = 0
            self._until_s = (now_s // BEHIND_S + 1) * BEHIND_S if self.behind else now_s + WINDOW_S
        self._offered += 1

    def lose(self, count: int) -> None:
        """So many were dropped for newer ones."""
        self._lost += count

    def skip(self, count: int) -> None:
        """So many were not even offered."""
        self._offered += count
        self._lost += count
