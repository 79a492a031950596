"""What a comparison of two recordings has found."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from shmio.layout.codec import Value


@dataclass(slots=True)
class RegisterDifference:
    """A register that differs in ``count`` frames, first in those at these times; ``largest``: of numbers."""

    count: int
    first: tuple[int, int]
    values: tuple[Value, Value]
    largest: float = 0.0


@dataclass(slots=True)
class Difference:
    """Something that differs first: at these log times, numbers of frames or events; None: one has none."""

    times_ns: tuple[int | None, int | None]
    numbers: tuple[int | None, int | None]
    what: list[str]


@dataclass(slots=True)
class Side:
    """Frames or events of one source in both."""

    compared: int = 0
    differing: int = 0
    only_first: int = 0
    only_second: int = 0
    first: Difference | None = None

    @property
    def same(self) -> bool:
        """Whether both have the same."""
        return not (self.differing or self.only_first or self.only_second)


class Timing:
    """How far the distances of frames to the first one differ; percentiles to 5 %, in little memory."""

    def __init__(self) -> None:
        self._bins: dict[int, int] = {}
        self._count = 0
        self._first: tuple[int, int] | None = None
        self.max_ns = 0

    def add(self, first_ns: int, second_ns: int) -> None:
        """Log times of two frames that belong together."""
        if self._first is None:
            self._first = first_ns, second_ns
        error_ns = abs((first_ns - self._first[0]) - (second_ns - self._first[1]))
        self.max_ns = max(self.max_ns, error_ns)
        place = round(math.log(error_ns + 1) * 20)
        self._bins[place] = self._bins.get(place, 0) + 1
        self._count += 1

    def percentile_ns(self, percent: float) -> int:
        """So many of the errors are at most this; 0 without any."""
        rest = self._count * percent / 100
        for place in sorted(self._bins):
            rest -= self._bins[place]
            if rest <= 0:
                return min(round(math.exp(place / 20) - 1), self.max_ns)
        return self.max_ns


@dataclass(slots=True)
class SourceDifference:
    """One source in both recordings."""

    source: str
    frames: Side = field(default_factory=Side)
    events: Side = field(default_factory=Side)
    registers: dict[str, RegisterDifference] = field(default_factory=dict)
    fields: dict[str, int] = field(default_factory=dict)
    """In how many frames something else differs."""
    missing: list[str] = field(default_factory=list)
    """Registers that only one has."""
    timing: Timing = field(default_factory=Timing)

    @property
    def same(self) -> bool:
        """Whether nothing differs that was asked for."""
        return self.frames.same and self.events.same and not self.missing
