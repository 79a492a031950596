"""Makes a failing case simpler, as long as the same expectation still fails."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

from shmio.config.campaign import campaign_of
from shmio.config.ranges import Dimension, Range, Space
from shmio.errors import ConfigError
from shmio.falsification.trial import Result

HALVINGS: Final = 4
"""How often the shrinker halves the distance between a value and a simpler value."""
DIGITS: Final = (1, 2, 3, 4)
"""The numbers of digits to which the shrinker tries to round a number, in this order."""
ROUNDS: Final = 2


@dataclass(frozen=True)
class Case:
    """A campaign without ranges: a point of a space, perhaps with fewer injections and a shorter duration.

    Attributes:
        point: The value of each dimension.
        duration_s: Duration of the campaign in s.
        dropped: Indices of the injections that are left out.

    """

    point: dict[str, Any]
    duration_s: float
    dropped: frozenset[int] = frozenset()

    def tables(self, space: Space) -> dict[str, Any]:
        """Return the tables of the campaign; ``space`` is the space of the point."""
        tables = space.at(self.point)
        kept = [table for index, table in enumerate(tables.get("injection", [])) if index not in self.dropped]
        return {**tables, "duration_s": self.duration_s, "injection": kept}


class Shrinker:
    """Tries simpler cases, in a fixed order, with at most a given number of runs."""

    def __init__(
        self, space: Space, step_s: float, runs: int, try_out: Callable[[dict[str, Any]], Result | None]
    ) -> None:
        """Prepare to shrink one case.

        Args:
            space: The campaign's space.
            step_s: Length of a step in s.
            runs: Maximum number of runs.
            try_out: Runs a campaign; None if the user wants to stop.

        """
        self._space, self._step_s, self._try_out = space, step_s, try_out
        self._left = runs
        self.runs = 0
        """Number of runs."""
        self.stopped = False
        """Whether the user wants to stop."""

    def shrink(self, case: Case, result: Result) -> tuple[Case, Result]:
        """Return the simplest failing case that was found, and its result.

        Args:
            case: A case that fails.
            result: The result of this case.

        """
        worst = result.worst
        self._expectation = result.failed[0] if worst is None else worst.name
        self._case, self._result = case, result
        for _ in range(ROUNDS):
            before = self._case
            self._shorten()
            for index in range(len(self._space.at({}).get("injection", [])) - 1, -1, -1):
                if index not in self._case.dropped:
                    self._try(replace(self._case, dropped=self._case.dropped | {index}))
            kept = [
                one
                for one in self._space.dimensions
                if one.place[0] != "injection" or one.place[1] not in self._case.dropped
            ]
            for key in ("start_s", "delay_ms"):
                self._earlier([one for one in kept if isinstance(one, Range) and one.place[-1] == key])
            for one in kept:
                self._simplify(one)
            self._shorten()
            if self._case == before:
                break
        return self._case, self._result

    def _try(self, case: Case) -> bool:
        """Run a case, and keep it if it fails, too. Return whether it fails."""
        if self._left <= 0 or self.stopped or case == self._case:
            return False
        tables = case.tables(self._space)
        try:
            campaign_of(tables)
        except ConfigError:  # such as an end before a start
            return False
        result = self._try_out(tables)
        if result is None:
            self.stopped = True
            return False
        self._left -= 1
        self.runs += 1
        if self._expectation not in result.failed:
            return False
        self._case, self._result = case, result
        return True

    def _shorten(self) -> None:
        """Let the run end soon after the moment of the failure."""
        moment_s = next((one.moment_s for one in self._result.expectations if one.name == self._expectation), None)
        least = 1 if moment_s is None else math.ceil((moment_s - self._result.begin_s) / self._step_s + 1e-9) + 2
        low, high = least, round(self._case.duration_s / self._step_s)
        if low >= high or self._lasting(low):
            return
        for _ in range(HALVINGS):
            middle = (low + high) // 2
            if middle in (low, high):
                return
            low, high = (low, middle) if self._lasting(middle) else (middle, high)

    def _lasting(self, steps: int) -> bool:
        return self._try(replace(self._case, duration_s=float(f"{steps * self._step_s:.9g}")))

    def _simplify(self, one: Dimension) -> None:
        """Bring a value as close to the simplest one as possible, and round it."""
        if self._with(one, one.simplest) or not isinstance(one, Range):
            return
        passing, failing = one.simplest, self._case.point[one.name]
        for _ in range(HALVINGS):
            middle = one.nearest((passing + failing) / 2)
            if middle in (passing, failing):
                break
            passing, failing = (passing, middle) if self._with(one, middle) else (middle, failing)
        if one.step is None and not one.whole:
            for value in _rounded(self._case.point[one.name]):
                if one.nearest(value) == value and self._with(one, value):
                    return

    def _earlier(self, times: list[Range]) -> None:
        """Move several times to earlier ones by the same amount, so that the times between them stay."""
        if len(times) < 2:
            return
        before = self._case.point
        fails, passes = 0.0, min(before[one.name] - one.low for one in times)
        amount = passes
        for _ in range(HALVINGS):
            point = {one.name: one.nearest(before[one.name] - amount) for one in times}
            if not self._try(replace(self._case, point={**self._case.point, **point})):
                passes = amount
            elif amount == passes:
                return
            else:
                fails = amount
            amount = (fails + passes) / 2

    def _with(self, one: Dimension, value: Any) -> bool:
        return self._try(replace(self._case, point={**self._case.point, one.name: value}))


def _rounded(value: float) -> Iterator[float]:
    """Yield a number with fewer digits, the fewest first."""
    for digits in DIGITS:
        found = float(f"{value:.{digits}g}")
        if found == value:
            return
        yield found
