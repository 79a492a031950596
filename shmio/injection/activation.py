"""Decides when a declared injection is active.

An injection is active between two times, while a condition is true, or for some time after a
condition has become true. (The testing metamodel of the University of York calls these three cases
activation at a fixed time, activation on a condition, and activation on a condition for a limited
time.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """The state of a declared injection."""

    WAITING = "waiting"
    ACTIVE = "active"
    OVER = "over"
    """The injection cannot become active again."""
    LIFTED = "lifted"
    """A client has lifted the injection, which the configuration still declares."""


_WAITING, _ACTIVE, _OVER, _LIFTED = State  # each cycle needs these, and looking up a member of an enum is slow


@dataclass(frozen=True, slots=True)
class Window:
    """Limits on when, how long and how often an injection is active.

    ``start_ns`` and ``end_ns`` are times of the instance's clock. ``for_ns`` is the length of each
    activation, in ns. ``times`` is the maximum number of activations. None stands for no limit.
    """

    start_ns: int = 0
    end_ns: int | None = None
    for_ns: int | None = None
    times: int | None = None


@dataclass(slots=True)
class Activation:
    """Tracks whether an injection is active, and how often it has been active.

    ``runs`` is the number of activations so far. ``cycle`` and ``time_ns`` are the cycle and the
    instance's clock at which the last activation began.
    """

    window: Window
    state: State = State.WAITING
    runs: int = 0
    cycle: int = 0
    time_ns: int = 0
    met: bool | None = None
    """True if the last cycle was in the window and the condition was true in it; None before the first cycle."""

    def advance(self, time_ns: int, cycle: int, *, holds: bool) -> bool:
        """Update the state for a cycle, and return whether the state has changed.

        Args:
            time_ns: The instance's clock in this cycle.
            cycle: The number of the cycle.
            holds: True if the condition is true in this cycle, or if there is no condition.

        """
        before, window = self.state, self.window
        if before is _OVER or before is _LIFTED:
            return False
        ended = window.end_ns is not None and time_ns >= window.end_ns
        met = holds and time_ns >= window.start_ns and not ended
        if before is _ACTIVE and self._stops(time_ns, met=met, ended=ended):
            self.state = _WAITING
        elif before is _WAITING and met and self._begins():
            self.state, self.runs = _ACTIVE, self.runs + 1
            self.cycle, self.time_ns = cycle, time_ns
        self.met = met
        used_up = window.times is not None and self.runs >= window.times
        if self.state is _WAITING and (ended or used_up):
            self.state = _OVER
        return self.state is not before

    def steady_until(self, time_ns: int) -> float:
        """Return the next time in ns at which the window begins or ends, or at which the activation ends.

        If a call of :meth:`advance` has changed nothing, not even :attr:`met`, further calls change
        nothing before this time, as long as ``holds`` is the same.
        """
        window = self.window
        limits = [window.start_ns]
        if window.end_ns is not None:
            limits.append(window.end_ns)
        if window.for_ns is not None:
            limits.append(self.time_ns + window.for_ns)
        return min((limit for limit in limits if limit > time_ns), default=math.inf)

    def _begins(self) -> bool:
        """Return whether a waiting injection becomes active now that its condition is true.

        With ``for_ns``, it becomes active only in a cycle in which the condition changes from false
        to true. A restarted process does not know the previous value of the condition. If the
        injection was active before, the process therefore waits for the next change.
        """
        if self.window.for_ns is None:
            return True
        return not self.met and (self.met is not None or not self.runs)

    def _stops(self, time_ns: int, *, met: bool, ended: bool) -> bool:
        if self.window.for_ns is None:
            return not met
        return ended or time_ns >= self.time_ns + self.window.for_ns
