"""The absolute schedule of a source: cycle k is due at start + k·period."""

from __future__ import annotations

from typing import NamedTuple


class Due(NamedTuple):
    """The next cycle.

    ``due_ns`` is when it is due and may be past; ``skipped`` counts the cycles skipped to reach it.
    """

    cycle: int
    due_ns: int
    skipped: int


class Schedule:
    """Counts cycles from the start of the instance, so that cycles lost by a restart show as a gap.

    A cycle that begins late still runs. A cycle whose whole period has passed is an overrun and is
    skipped.
    """

    def __init__(self, start_ns: int, period_ns: int) -> None:
        self._start_ns = start_ns
        self._period_ns = period_ns
        self._last: int | None = None

    def moved(self, ahead_ns: int, lead: int) -> Schedule:
        """Return a schedule for a clock that is ``ahead_ns`` ahead, with ``lead`` cycles added."""
        return Schedule(self._start_ns - ahead_ns - lead * self._period_ns, self._period_ns)

    def next(self, now_ns: int) -> Due:
        """Return the next cycle, skipping those whose whole period has passed."""
        current = self.at(now_ns)
        if self._last is None:
            cycle, skipped = current + 1, 0
        else:
            cycle = max(self._last + 1, current)
            skipped = cycle - self._last - 1
        self._last = cycle
        return Due(cycle, self.due_ns(cycle), skipped)

    def due_ns(self, cycle: int) -> int:
        """Return when a cycle is due, in ns."""
        return self._start_ns + cycle * self._period_ns

    def at(self, now_ns: int) -> int:
        """Return the cycle that was due last. No later process begins with an earlier cycle."""
        return (now_ns - self._start_ns) // self._period_ns

    def restart(self) -> None:
        """Forget the last cycle: the time until the next one is an outage and not an overrun."""
        self._last = None
