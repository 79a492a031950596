"""Evaluates formulas at the start of the judged time, and defines the verdicts on expectations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite

import numpy as np

from shmio.config import Expectation
from shmio.injection.exact import LARGE
from shmio.judging.operators import Node
from shmio.judging.pieces import NOTHING, TINY, Alignment, Piece, Values, cut, head


def number_text(number: float, digits: int) -> str:
    """Return a number with all digits if it is whole and exact, else with the given number of digits."""
    if isinstance(number, int) or (number.is_integer() and abs(number) < LARGE):
        return str(int(number))
    return f"{number:.{digits}g}"


class Outcome(StrEnum):
    """The outcome of a verdict."""

    PASSED = "passed"
    FAILED = "failed"
    INCONCLUSIVE = "inconclusive"


class TopLevel:
    """An outermost part of a formula. It is evaluated only at the start of the judged time.

    ``low`` and ``high`` are the bounds of its truth, from what is known so far.
    """

    low: float = -np.inf
    high: float = np.inf
    extreme_ns: int | None = None
    """The moment of the value that is closest to changing the outcome; None if it is not known."""

    def turn(self) -> None:
        """Read the newly known parts of the operands."""
        raise NotImplementedError

    def finish(self, end_ns: int) -> None:
        """Set the end of the judged time. One last :meth:`turn` follows, with the rest of the signals."""

    def decided_ns(self) -> int | None:
        """Return the moment, in instance time, at which the truth was decided; None if it is not known."""
        raise NotImplementedError

    def unknown_ns(self) -> int | None:
        """Return the first moment at which an unknown value leaves the truth undecided; None if there is none."""
        raise NotImplementedError


class TopLevelInitial(TopLevel):
    """The truth of a signal at the start of the judged time."""

    def __init__(self, operand: Node) -> None:
        self._operand = operand
        self._at_ns: int | None = None

    def turn(self) -> None:
        """Read the first value of the signal."""
        piece = self._operand.out
        if self._at_ns is None and len(piece.time):
            self._at_ns = int(piece.time[0])
            self.low, self.high = float(piece.low[0]), float(piece.high[0])

    def decided_ns(self) -> int | None:
        """Return the start of the judged time; None if the signal has no value yet."""
        return self._at_ns

    def unknown_ns(self) -> int | None:
        """Return the start of the judged time; None if the signal has no value yet."""
        return self._at_ns


class TopLevelExtremum(TopLevel):
    """The least value of a signal in a span of time (``always``), or the greatest (``eventually``).

    Args:
        function: ``np.minimum`` for ``always``, ``np.maximum`` for ``eventually``.
        operand: The signal.
        bounds_ns: Start and end of the span, relative to the start of the judged time; None for the
            whole judged time.
    """

    def __init__(self, function: np.ufunc, operand: Node, bounds_ns: tuple[int, int] | None) -> None:
        self._always = function is np.minimum
        self._operand = operand
        self._bounds_ns = bounds_ns
        self._range: tuple[int, int | None] | None = None
        self._end_ns: int | None = None
        self._over = False
        self._low, self._high = (np.inf, np.inf) if self._always else (-np.inf, -np.inf)
        self._decided_ns: int | None = None
        self._unknown_ns: int | None = None

    def turn(self) -> None:
        """Include the newly known values in the span."""
        piece = self._operand.out
        if self._over or not len(piece.time):
            return
        if self._range is None:
            origin = int(piece.time[0])
            first, last = self._bounds_ns or (0, None)
            self._range = origin + first, None if last is None else origin + last + 1
        begin, end = self._range
        end = self._end_ns if end is None else end
        self._over = end is not None and piece.end >= end
        if piece.time[0] < begin:
            piece = cut(piece, begin)
        if end is not None:
            piece = head(piece, end) if len(piece.time) and piece.time[0] < end else NOTHING
        if len(piece.time):
            self._add(piece)
        self.low = self._low if self._over or not self._always else -np.inf
        self.high = self._high if self._over or self._always else np.inf

    def _add(self, piece: Piece) -> None:
        time, low, high, _ = piece
        if self._always:
            place, best, decided = int(low.argmin()), float(low.min()), high < 0
            better = best < self._low
            self._low, self._high = min(self._low, best), min(self._high, float(high.min()))
        else:
            place, best, decided = int(high.argmax()), float(high.max()), low > 0
            better = best > self._high
            self._low, self._high = max(self._low, float(low.max())), max(self._high, best)
        if better or self.extreme_ns is None:
            self.extreme_ns = int(time[place])
        if self._decided_ns is None and decided.any():
            self._decided_ns = int(time[decided.argmax()])
        if high is not low and self._unknown_ns is None:
            unknown = (low < 0) & (high > 0)
            if unknown.any():
                self._unknown_ns = int(time[unknown.argmax()])

    def finish(self, end_ns: int) -> None:
        """Set the end of the judged time. A span without bounds ends there."""
        self._end_ns = end_ns

    def decided_ns(self) -> int | None:
        """Return the first moment that decides the truth, or else the end of the span; None if it has no end yet."""
        if self._decided_ns is not None:
            return self._decided_ns
        if self._range is None:
            return None
        end = self._range[1] if self._range[1] is not None else self._end_ns
        return None if end is None else end - 1

    def unknown_ns(self) -> int | None:
        """Return the first moment in the span at which the truth of the signal is unknown; None if there is none."""
        return self._unknown_ns


class UntilEnd(TopLevel):
    """Whether ``right`` becomes true within the judged time, and ``left`` is true until then."""

    def __init__(self, left: Node, right: Node) -> None:
        self._operands = (left, right)
        self._alignment = Alignment(2)
        self._left = [np.inf, np.inf]  # the least values up to now, of the bounds
        self._found = [-np.inf, -np.inf]
        self._end_ns: int | None = None
        self._decided_ns: int | None = None
        self._unknown_ns: int | None = None

    def turn(self) -> None:
        """Include the newly known values."""
        left, right = self._alignment.align([operand.out for operand in self._operands])
        if self._end_ns is not None and len(left.time):
            if left.time[0] >= self._end_ns:
                left = right = NOTHING
            else:
                left, right = head(left, self._end_ns), head(right, self._end_ns)
        if len(left.time):
            bounds = [self._add(0, left.low, right.low), self._add(1, left.high, right.high)]
            decided = (bounds[0] > 0) | (np.minimum.accumulate(left.high) < 0)
            if self._decided_ns is None and decided.any():
                self._decided_ns = int(left.time[decided.argmax()])
            unknown = (bounds[0] < 0) & (bounds[1] > 0)
            if self._unknown_ns is None and unknown.any():
                self._unknown_ns = int(left.time[unknown.argmax()])
        self.low = self._found[0]
        self.high = self._found[1] if self._end_ns is not None else max(self._found[1], self._left[1])

    def _add(self, which: int, left: Values, right: Values) -> Values:
        before = np.minimum.accumulate(np.concatenate(([self._left[which]], left)))
        found = np.maximum(np.maximum.accumulate(np.minimum(right, before[:-1])), self._found[which])
        self._left[which], self._found[which] = float(before[-1]), float(found[-1])
        return found

    def finish(self, end_ns: int) -> None:
        """Set the end of the judged time."""
        self._end_ns = end_ns

    def decided_ns(self) -> int | None:
        """Return the first moment that decides the truth, or else the end of the judged time.

        Return None while the judged time has no end.
        """
        return self._decided_ns if self._decided_ns is not None or self._end_ns is None else self._end_ns - 1

    def unknown_ns(self) -> int | None:
        """Return the first moment at which the truth is unknown; None if there is none."""
        return self._unknown_ns


class Opposite(TopLevel):
    """The negation of another part."""

    def __init__(self, operand: TopLevel) -> None:
        self._operand = operand

    def turn(self) -> None:
        """Compute the bounds from those of the operand."""
        self._operand.turn()
        self.low, self.high = -self._operand.high, -self._operand.low

    def finish(self, end_ns: int) -> None:
        """Pass the end of the judged time to the operand."""
        self._operand.finish(end_ns)

    def decided_ns(self) -> int | None:
        """Return the moment at which the operand was decided."""
        return self._operand.decided_ns()

    def unknown_ns(self) -> int | None:
        """Return the first moment that leaves the operand undecided."""
        return self._operand.unknown_ns()


class All(TopLevel):
    """Whether several parts are all true."""

    def __init__(self, operands: Sequence[TopLevel]) -> None:
        self._operands = operands

    def turn(self) -> None:
        """Set each bound to the least of the parts' bounds."""
        for operand in self._operands:
            operand.turn()
        self.low = min(operand.low for operand in self._operands)
        self.high = min(operand.high for operand in self._operands)

    def finish(self, end_ns: int) -> None:
        """Pass the end of the judged time to all parts."""
        for operand in self._operands:
            operand.finish(end_ns)

    def decided_ns(self) -> int | None:
        """Return the first moment at which a part became false, or else the last moment at which a part was decided."""
        false = [operand.decided_ns() for operand in self._operands if operand.high < 0]
        moments = [moment for moment in false or [one.decided_ns() for one in self._operands] if moment is not None]
        if not moments:
            return None
        return min(moments) if false else max(moments)

    def unknown_ns(self) -> int | None:
        """Return the first moment at which an unknown value leaves a part undecided; None if there is none."""
        moments = [one.unknown_ns() for one in self._operands if one.low < 0 < one.high]
        return min((moment for moment in moments if moment is not None), default=None)


@dataclass(frozen=True)
class Verdict:
    """The verdict on an expectation. All times are on the instance's clock, in ns.

    Attributes:
        expectation: The expectation.
        outcome: Passed, failed or inconclusive.
        reason: Why the expectation has not passed; empty if it has.
        low: Lower bound of the robustness.
        high: Upper bound of the robustness. Equal to ``low`` if everything that matters was known.
        moment_ns: First moment at which the expectation was not met; None if it has not failed, or
            the moment is not known.
        extreme_ns: Moment at which the expectation was closest to failing, or furthest from being
            met; None if it is not known.
        around: For each signal, its values before and after ``moment_ns``, as pairs of a time and a
            value; the value is None where it was unknown.
    """

    expectation: Expectation
    outcome: Outcome
    reason: str
    low: float
    high: float
    moment_ns: int | None
    extreme_ns: int | None
    around: Mapping[str, Sequence[tuple[int, float | None]]]

    @property
    def robustness(self) -> float | None:
        """The distance to failing: negative if failed; None if the verdict is inconclusive or there is no limit.

        If the exact distance is not known, this is the bound that is closer to 0.
        """
        if self.outcome is Outcome.INCONCLUSIVE:
            return None
        bound = self.low if self.outcome is Outcome.PASSED else self.high
        return distance(bound)


def distance(bound: float) -> float | None:
    """Return a bound of the robustness as reports show it: 0 for the least distance, None if infinite."""
    if not isfinite(bound):
        return None
    return 0.0 if abs(bound) == TINY else bound
