"""When a declared injection is active: between two times, while a condition holds, or for a while after it came true.

York's metamodel of tests calls these activation at a fixed time, on a condition, on a condition for a limited time.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """Where a declared injection is in its life."""

    WAITING = "waiting"
    ACTIVE = "active"
    OVER = "over"
    """It will not be active again."""
    LIFTED = "lifted"
    """Somebody has lifted it, though the configuration still has it."""


@dataclass(frozen=True, slots=True)
class Window:
    """Times in ns on the instance's clock; ``for_ns``: how long an activation lasts; ``times``: the most of them."""

    start_ns: int = 0
    end_ns: int | None = None
    for_ns: int | None = None
    times: int | None = None


@dataclass(slots=True)
class Activation:
    """The present state; ``runs`` counts activations, ``cycle`` and ``time_ns`` are those of the last one's begin."""

    window: Window
    state: State = State.WAITING
    runs: int = 0
    cycle: int = 0
    time_ns: int = 0
    met: bool | None = None
    """Whether it was to be active when it was looked last; None: nobody has looked yet."""

    def advance(self, time_ns: int, cycle: int, *, holds: bool) -> bool:
        """Look at a cycle, with what its condition is (True without one); whether the state has changed."""
        if self.state in (State.OVER, State.LIFTED):
            return False
        before, window = self.state, self.window
        ended = window.end_ns is not None and time_ns >= window.end_ns
        met = holds and time_ns >= window.start_ns and not ended
        if self.state is State.ACTIVE and self._stops(time_ns, met=met, ended=ended):
            self.state = State.WAITING
        elif self.state is State.WAITING and met and self._begins():
            self.state, self.runs = State.ACTIVE, self.runs + 1
            self.cycle, self.time_ns = cycle, time_ns
        self.met = met
        used_up = window.times is not None and self.runs >= window.times
        if self.state is State.WAITING and (ended or used_up):
            self.state = State.OVER
        return self.state is not before

    def _begins(self) -> bool:
        """Whether one whose condition holds becomes active.

        One that lasts for a while does so where its condition comes true; in a process that goes on for another, which
        does not know what it was before, not at once.
        """
        if self.window.for_ns is None:
            return True
        return not self.met and (self.met is not None or not self.runs)

    def _stops(self, time_ns: int, *, met: bool, ended: bool) -> bool:
        if self.window.for_ns is None:
            return not met
        return ended or time_ns >= self.time_ns + self.window.for_ns
