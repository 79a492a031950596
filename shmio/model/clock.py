"""State of an instance's clock."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

STEP_SIZE_NS: Final = 50_000_000
"""Default length of a step, in ns."""


class ClockMode(IntEnum):
    """Mode of the clock: real time, or time that is moved by steps."""

    WALL = 0
    VIRTUAL = 1
    """Only steps move time, from take-over until release or the instance's end."""

    def __str__(self) -> str:
        return self.name.lower()


class Clock(NamedTuple):
    """State of an instance's clock.

    Attributes:
        mode: Whether time is real or virtual.
        step: Number of the last requested step.
        time_ns: The instance's clock after that step; in wall time, the present clock.
        dt_ns: Length of that step.
        done: Number of the last step that all sources have finished.
        step_size_ns: Length of a step that is requested without one.
        playing: True while the owner of time steps it continuously.
        rate: Speed of playing, relative to real time.
        stepping: True while the last requested step is under way.
        owner: Pid of the owner of time; 0: nobody.
        note: Text about the processes that a step waits for, or the problem of the last step.
        resumed_ns: In wall time: the clock at the last release of time.
        offset_ns: In wall time: the clock minus the real time since the instance's start.
    """

    mode: ClockMode = ClockMode.WALL
    step: int = 0
    time_ns: int = 0
    dt_ns: int = 0
    done: int = 0
    step_size_ns: int = STEP_SIZE_NS
    playing: bool = False
    rate: float = 1.0
    stepping: bool = False
    owner: int = 0
    note: str = ""
    resumed_ns: int = 0
    offset_ns: int = 0

    def __call__(self) -> Clock:
        """Return this state, so that ``cell.clock()`` works with local and remote cells."""
        return self

    @property
    def virtual(self) -> bool:
        """True if time is virtual: only steps move it."""
        return self.mode is ClockMode.VIRTUAL

    @property
    def present_ns(self) -> int:
        """The instance's clock; during a step the time before it."""
        return self.time_ns - self.dt_ns if self.stepping else self.time_ns

    @property
    def basis(self) -> tuple[ClockMode, int, int, int]:
        """Base of clock and cycles in wall time. It changes when time is taken over or released."""
        return self.mode, self.step, self.resumed_ns, self.offset_ns

    def lead(self, period_ns: int) -> int:
        """Return the lead of cycles over the clock in wall time: cycle = clock // period + lead."""
        return self.step - self.resumed_ns // period_ns
