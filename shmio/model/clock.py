"""State of an instance's clock."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

STEP_SIZE_NS: Final = 50_000_000
"""Default length of a step."""


class ClockMode(IntEnum):
    """Mode of the clock: real time, or time that is moved by steps."""

    WALL = 0
    VIRTUAL = 1
    """Only steps move time, from take-over until release or the end of the instance."""

    def __str__(self) -> str:
        return self.name.lower()


class Clock(NamedTuple):
    """State of an instance's clock.

    Attributes:
        mode: Whether time is real or virtual.
        step: Number of the last requested step.
        time_ns: The instance's clock after that step; in wall time the clock now.
        dt_ns: Length of that step.
        done: Number of the last step that all sources have finished.
        step_size_ns: Default length of a step.
        playing: Whether the owner of time steps continuously.
        rate: Speed of playing, relative to real time.
        stepping: Whether the last requested step is under way.
        owner: Pid of the owner of time; 0: nobody.
        note: Which processes a step waits for, why the last step failed, or what it did not move.
        resumed_ns: In wall time: the clock at which time was released.
        offset_ns: In wall time: how far the clock is ahead of the real time since the start.
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
        """Return this state, so that ``cell.clock`` of a local cell can be called as that of a remote one."""
        return self

    @property
    def virtual(self) -> bool:
        """Whether time is virtual: only steps move it."""
        return self.mode is ClockMode.VIRTUAL

    @property
    def present_ns(self) -> int:
        """The instance's clock; during a step the time before it."""
        return self.time_ns - self.dt_ns if self.stepping else self.time_ns

    @property
    def basis(self) -> tuple[ClockMode, int, int, int]:
        """Base of clock and cycles in wall time; it changes whenever time is taken over or released."""
        return self.mode, self.step, self.resumed_ns, self.offset_ns

    def lead(self, period_ns: int) -> int:
        """Return how many cycles of this period are ahead of the clock, in wall time."""
        return self.step - self.resumed_ns // period_ns
