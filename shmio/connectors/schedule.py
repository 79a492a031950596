"""The absolute schedule of a source: cycle k is due at start + k·period, whatever happened before."""

from __future__ import annotations

from typing import NamedTuple


class Due(NamedTuple):
    """The next cycle, when it is due (now, if that is past), and how many cycles were skipped to reach it."""

    cycle: int
    due_ns: int
    skipped: int


class Schedule:
    """Counts cycles from the instance's start, so that cycles lost by a restart show as a gap in their numbers.

    A cycle that begins late still runs; one whose whole period has passed is an overrun and is skipped.
    """

    def __init__(self, start_ns: int, period_ns: int) -> None:
        self._start_ns = start_ns
        self._period_ns = period_ns
        self._last: int | None = None

    def moved(self, ahead_ns: int, lead: int) -> Schedule:
        """One that counts by a clock that is so far ahead, and so many cycles beyond that."""
        return Schedule(self._start_ns - ahead_ns - lead * self._period_ns, self._period_ns)

    def next(self, now_ns: int) -> Due:
        """The cycle after the last one given, or a later one if that is wholly past."""
        current = self.at(now_ns)
        if self._last is None:
            cycle, skipped = current + 1, 0
        else:
            cycle = max(self._last + 1, current)
            skipped = cycle - self._last - 1
        self._last = cycle
        return Due(cycle, self.due_ns(cycle), skipped)

    def due_ns(self, cycle: int) -> int:
        """When a cycle is due."""
        return self._start_ns + cycle * self._period_ns

    def at(self, now_ns: int) -> int:
        """The cycle that was due last: no process to come begins with one before."""
        return (now_ns - self._start_ns) // self._period_ns

    def restart(self) -> None:
        """Forget the last cycle: what passes until the next one is an outage, not an overrun."""
        self._last = None


class Backoff:
    """Waiting times between attempts to connect: doubling from ``first_s`` to ``most_s``."""

    def __init__(self, first_s: float = 0.1, most_s: float = 2.0) -> None:
        self._first_s = first_s
        self._most_s = most_s
        self._next_s = first_s

    def next_s(self) -> float:
        """The time to wait now, longer at each call."""
        wait_s, self._next_s = self._next_s, min(2 * self._next_s, self._most_s)
        return wait_s

    def reset(self) -> None:
        """Begin again with the shortest."""
        self._next_s = self._first_s
