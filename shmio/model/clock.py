"""State of an instance's clock."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

import msgspec

from shmio.errors import ValueRangeError

STEP_SIZE_NS: Final = 50_000_000
"""Default length of a step, in ns."""
MIN_STEP_NS: Final = 1_000
MAX_STEP_NS: Final = 3_600_000_000_000
MAX_RATE: Final = 1000.0
"""Maximum speed of playing, relative to real time."""


class ClockMode(IntEnum):
    """Mode of the clock: wall time (real time), or virtual time, which only steps move."""

    WALL = 0
    VIRTUAL = 1
    """Only steps move time. Virtual time lasts from take-over until release or the instance's end."""

    def __str__(self) -> str:
        return self.name.lower()


class Clock(NamedTuple):
    """State of an instance's clock.

    Attributes:
        mode: Whether time is real (wall time) or virtual.
        step: Number of the last requested step.
        time_ns: Time of the instance's clock after that step, in ns; in wall time, the present time.
        dt_ns: Length of that step, in ns.
        done: Number of the last step that all sources have finished.
        step_size_ns: Default length of a step, in ns.
        playing: True while the program that owns time steps it continuously.
        rate: Speed of playing, relative to real time.
        stepping: True while the last requested step is in progress.
        owner: Pid of the program that owns time; 0: no program owns it.
        note: Text that names the processes that a step waits for, or the problem of the last step.
        resumed_ns: In wall time: the time of the clock at the last release of time, in ns.
        offset_ns: In wall time: the clock minus the real time since the instance's start, in ns.
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
        """Time of the instance's clock, in ns; during a step, the time before the step."""
        return self.time_ns - self.dt_ns if self.stepping else self.time_ns

    @property
    def basis(self) -> tuple[ClockMode, int, int, int]:
        """The values that determine clock and cycles in wall time; take-over and release change them."""
        return self.mode, self.step, self.resumed_ns, self.offset_ns

    def lead(self, period_ns: int) -> int:
        """Return the number to add to ``clock // period`` to get the cycle of a source in wall time.

        ``period_ns`` is the source's period.
        """
        return self.step - self.resumed_ns // period_ns


class ClockStatus(msgspec.Struct):
    """Status of the instance's clock. ``mode`` is wall or virtual; ``step`` is the last finished step.

    ``note`` says which processes a step waits for, why the last step failed, or on which sources it
    had no effect. Before the first step, it says how to return to real time.
    """

    mode: str
    time_s: float
    step: int
    step_size_ms: float
    playing: bool
    rate: float
    note: str


def clock_status(state: Clock) -> ClockStatus:
    """Convert the state of a clock to a status, which has times in s and ms."""
    return ClockStatus(
        str(state.mode), state.present_ns / 1e9, state.done, state.step_size_ns / 1e6, state.playing, state.rate,
        state.note,
    )  # fmt: skip


def check_step(dt_ns: float) -> None:
    """Raise ValueRangeError unless the length of a step, in ns, is from 1 us to 1 h."""
    if not MIN_STEP_NS <= dt_ns <= MAX_STEP_NS:
        raise ValueRangeError(f"the length of a step must be from 0.001 ms to 3600000 ms (1 h), not {dt_ns / 1e6:g} ms")
