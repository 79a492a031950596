"""What an emulated controller can run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from shmio.config.wording import meant
from shmio.emulators.a50 import A50
from shmio.emulators.counter import Counter
from shmio.emulators.idle import Idle
from shmio.errors import ConfigError
from shmio.layout.model import Layout


class Program(Protocol):
    """A controller's user program, together with the plant it moves."""

    @property
    def period_ms(self) -> int:
        """Time between two cycles."""

    def step(self, time_s: float, frame: bytearray) -> None:
        """Run the cycle of time ``time_s`` (since the program's start) on the block, in place.

        The same times on the same frames give the same frames. What the program does not drive, it leaves as clients
        wrote it; it may obey what is written there. ``frame`` keeps its length.
        """


IDLE = "idle"
PROGRAMS: Mapping[str, Callable[[Layout], Program]] = {"a50": A50, "counter": Counter, IDLE: Idle}


def program(name: str, layout: Layout) -> Program:
    """Build the program of this name for a block of this layout.

    ConfigError: no such program, or the layout has not the registers it needs.
    """
    try:
        build = PROGRAMS[name]
    except KeyError:
        raise ConfigError(
            f"program: {name!r} is none; there are: {', '.join(sorted(PROGRAMS))}{meant(name, PROGRAMS)}"
        ) from None
    return build(layout)
