"""Decides when a declared injection is active.

It is active between two times, while a condition holds, or for some time after that. York's
metamodel of tests calls these activation at a fixed time, on a condition, and on a condition for a
limited time.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """The state of a declared injection."""

    WAITING = "waiting"
    ACTIVE = "active"
    OVER = "over"
    """It cannot become active again."""
    LIFTED = "lifted"
    """It was lifted, but the configuration still has it."""


@dataclass(frozen=True, slots=True)
class Window:
    """Time limits in ns on the instance clock, per activation, and for their number."""

    start_ns: int = 0
    end_ns: int | None = None
    for_ns: int | None = None
    times: int | None = None


@dataclass(slots=True)
class Activation:
    """The activation state.

    ``runs`` counts activations; ``cycle`` and ``time_ns`` are when the last one began.
    """

    window: Window
    state: State = State.WAITING
    runs: int = 0
    cycle: int = 0
    time_ns: int = 0
    met: bool | None = None
    """Whether the condition and the window held at the last cycle; None before the first."""

    def advance(self, time_ns: int, cycle: int, *, holds: bool) -> bool:
        """Advance to a cycle; return whether the state has changed.

        Args:
            time_ns: The instance time of the cycle.
            cycle: The cycle.
            holds: Whether the condition holds; True without a condition.

        """
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
        """Return whether the injection becomes active, given that its condition holds.

        With ``for_ns`` it does when the condition becomes true. A restarted process does not know
        the earlier value of the condition, so there it does not become active at once.
        """
        if self.window.for_ns is None:
            return True
        return not self.met and (self.met is not None or not self.runs)

    def _stops(self, time_ns: int, *, met: bool, ended: bool) -> bool:
        if self.window.for_ns is None:
            return not met
        return ended or time_ns >= self.time_ns + self.window.for_ns
