"""The operators of formulas, as nodes of a network through which the pieces of signals pass.

In each turn, a node reads the newly known parts of its operands, and computes the part of its own
signal that they determine. The result does not depend on how a signal is divided into pieces. So
the same nodes serve a live cell, which delivers a few frames at a time, and a recording, which
delivers thousands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, Final

import numpy as np

from shmio.injection.exact import (
    ADD,
    DIVIDE,
    EXACTLY,
    MODULO,
    MULTIPLY,
    SUBTRACT,
    WHOLE,
    Exact,
    bounds,
    floats,
    is_exact,
)
from shmio.judging.pieces import FAR_NS, NOTHING, TINY, Alignment, Piece, Times, Values, cut, join

Numeric = Callable[..., Values]
"""Function that computes numbers from numbers: arrays, or constants."""


class Node:
    """A node of the network. ``out`` is the part of its signal that has become known in the present turn."""

    out: Piece = NOTHING

    def turn(self) -> None:
        """Read the newly known parts of the operands, and set ``out``."""
        raise NotImplementedError


class Input(Node):
    """A signal that comes from frames. Its source sets ``out``."""

    def turn(self) -> None:
        """Do nothing, because the source has set ``out`` already."""


# -- at each moment on its own -----------------------------------------------------------------------------------------


class _Pointwise(Node):
    """A signal that depends only on the present values of its operands."""

    def __init__(self, operands: Sequence[Node]) -> None:
        self._operands = operands
        self._alignment = Alignment(len(operands))

    def turn(self) -> None:
        if len(self._operands) == 1:
            pieces = [self._operands[0].out]
        else:
            pieces = self._alignment.align([operand.out for operand in self._operands])
        self.out = self.combine(pieces) if len(pieces[0].time) else NOTHING

    def combine(self, pieces: list[Piece]) -> Piece:
        """Return the result for pieces with the same times."""
        raise NotImplementedError


class Arithmetic(_Pointwise):
    """A number that is computed from other numbers; NaN if one of them is unknown.

    Args:
        function: Computes the number.
        operands: The other numbers.
        exactly: Computes the number from integers without rounding it. It takes the place of
            ``function`` if a result is beyond 2**53. None if a result may be rounded.
    """

    def __init__(self, function: Numeric, operands: Sequence[Node | Exact], exactly: Numeric | None = None) -> None:
        super().__init__([operand for operand in operands if isinstance(operand, Node)])
        self._function = function
        self._exactly = exactly
        self._constants = [None if isinstance(operand, Node) else operand for operand in operands]

    def combine(self, pieces: list[Piece]) -> Piece:
        """Compute the number at each time."""
        values = iter(pieces)
        arguments = [next(values).low if constant is None else constant for constant in self._constants]
        with np.errstate(all="ignore"):
            found = self._function(*arguments)
            if self._exactly is not None and found.dtype != object and (np.abs(found) >= WHOLE).any():
                found = self._exactly(*arguments)
        return Piece(pieces[0].time, found, found, pieces[0].end)


class Truth(Arithmetic):
    """The truth of numbers. The function computes the distance: positive is true, negative is false."""

    def combine(self, pieces: list[Piece]) -> Piece:
        """Compute the truth at each time."""
        time, distance, _, end = super().combine(pieces)
        unknown = np.isnan(distance)
        if not unknown.any():
            return Piece(time, distance, distance, end)
        return Piece(time, np.where(unknown, -np.inf, distance), np.where(unknown, np.inf, distance), end)


class Constantly(_Pointwise):
    """A constant truth, with the times of another signal."""

    def __init__(self, value: float, other: Node) -> None:
        super().__init__((other,))
        self._value = value

    def combine(self, pieces: list[Piece]) -> Piece:
        """Return the constant at each time."""
        values = np.full(len(pieces[0].time), self._value)
        return Piece(pieces[0].time, values, values, pieces[0].end)


class Digit(_Pointwise):
    """A truth as a number: 1 is true, 0 is false, NaN is unknown."""

    def combine(self, pieces: list[Piece]) -> Piece:
        """Compute 1, 0 or NaN at each time."""
        time, low, high, end = pieces[0]
        found = np.where(low > 0, 1.0, np.where(high < 0, 0.0, np.nan))
        return Piece(time, found, found, end)


class Not(_Pointwise):
    """The negation of a truth."""

    def combine(self, pieces: list[Piece]) -> Piece:
        """Compute the opposite at each time."""
        time, low, high, end = pieces[0]
        opposite = -low
        return Piece(time, opposite if high is low else -high, opposite, end)


class Extremum(_Pointwise):
    """The least value of several truths (``and``), or the greatest (``or``)."""

    def __init__(self, function: np.ufunc, operands: Sequence[Node]) -> None:
        super().__init__(operands)
        self._function = function

    def combine(self, pieces: list[Piece]) -> Piece:
        """Compute the least or the greatest value at each time."""
        found = pieces[0]
        for piece in pieces[1:]:
            low = self._function(found.low, piece.low)
            known = found.high is found.low and piece.high is piece.low
            found = Piece(found.time, low, low if known else self._function(found.high, piece.high), found.end)
        return found


# -- between a frame and the one before --------------------------------------------------------------------------------


class Edge(Node):
    """Whether a truth has become true since the previous frame. :class:`Moment` turns this into an event.

    Args:
        operand: The truth.
        first: Whether a truth that is true in the first frame counts as having become true there.
    """

    def __init__(self, operand: Node, *, first: bool) -> None:
        self._operand = operand
        self._before: tuple[float, float] = (-np.inf, -np.inf) if first else (np.inf, np.inf)

    def turn(self) -> None:
        """Compare each value with the previous one."""
        time, low, high, end = self._operand.out
        if not len(time):
            self.out = NOTHING
            return
        found = np.minimum(low, -_shifted(high, self._before[1]))
        known = high is low and self._before[0] == self._before[1]
        upper = found if known else np.minimum(high, -_shifted(low, self._before[0]))
        self._before = float(low[-1]), float(high[-1])
        self.out = Piece(time, found, upper, end)


class Moment(Node):
    """Turns a comparison with the previous frame into an event, which is true only at the frame's own moment.

    Args:
        edge: The comparison.
        operand: The signal that ``edge`` compares. Where it is unknown, the event may come at any
            moment.
    """

    def __init__(self, edge: Node, operand: Node) -> None:
        self._edge = edge
        self._operand = operand

    def turn(self) -> None:
        """Add a false value directly after the moment of each frame."""
        time, low, high, end = self._edge.out
        if not len(time):
            self.out = NOTHING
            return
        operand, upper = floats(self._operand.out.low), floats(self._operand.out.high)
        after = time + 1
        room = np.append(after[:-1] < time[1:], after[-1] < end)
        open_ = np.isnan(operand) | ((operand < 0) & (upper > 0))
        moments = np.stack((time, after), axis=1).reshape(-1)
        kept = np.stack((np.ones(len(time), bool), room), axis=1).reshape(-1)
        no = np.full(len(time), -np.inf)
        found = np.stack((low, no), axis=1).reshape(-1)[kept]
        known = high is low and not open_.any()
        later = np.where(open_, np.where(np.isnan(upper), np.inf, upper), no)
        most = found if known else np.stack((high, later), axis=1).reshape(-1)[kept]
        self.out = Piece(moments[kept], found, most, end)


class Difference(Node):
    """The difference between a number and its value in the previous frame; 0 in the first frame.

    With ``per_second``, it is divided by the time in s between the frames.
    """

    def __init__(self, operand: Node, *, per_second: bool) -> None:
        self._operand = operand
        self._per_second = per_second
        self._before: tuple[int, Any] | None = None

    def turn(self) -> None:
        """Subtract the previous value from each value."""
        time, values, _, end = self._operand.out
        if not len(time):
            self.out = NOTHING
            return
        time_ns, value = self._before or (int(time[0]) - 1, values[0])
        with np.errstate(all="ignore"):
            found = floats(_difference(values, _shifted(values, value)))
            if self._per_second:
                passed = np.empty(len(time))
                passed[0], passed[1:] = time[0] - time_ns, np.diff(time)
                found = found / (passed / 1e9)
        if self._before is None:
            found[0] = 0.0
        self._before = int(time[-1]), values[-1]
        self.out = Piece(time, found, found, end)


def _shifted(values: Values, before: Any) -> Values:
    kind = object if isinstance(before, (int, Fraction)) else values.dtype
    shifted = np.empty(len(values), kind)
    shifted[0], shifted[1:] = before, values[:-1]
    return shifted


# -- over times --------------------------------------------------------------------------------------------------------


class Window(Node):
    """The greatest or the least value of a signal between ``t + begin`` and ``t + end``, at each t.

    This is a temporal operator within another operator. At the top level of a formula,
    ``verdict.TopLevelExtremum`` takes its place.

    A window reaches into the future (``begin`` and ``end`` are at least 0: ``eventually``,
    ``always``) or into the past (both are at most 0: ``once``, ``historically``). For a window that
    ends before the judged time begins, ``once`` is false, and ``historically`` is true.

    The node keeps only the values that can still decide a future result. Each window that is not
    computed yet reaches at least up to the newest value. For the greatest value, the node therefore
    needs to keep, for each moment, only the greatest value from this moment up to the newest.

    Args:
        function: ``np.maximum`` or ``np.minimum``.
        operand: The signal.
        begin_ns: Start of the window relative to t.
        end_ns: End of the window relative to t, inclusive.
    """

    def __init__(self, function: np.ufunc, operand: Node, begin_ns: int, end_ns: int) -> None:
        self._function = function
        self._operand = operand
        self._begin_ns, self._end_ns = begin_ns, end_ns
        self._neutral = -np.inf if function is np.maximum else np.inf
        self._kept = NOTHING
        self._done_ns: int | None = None

    def turn(self) -> None:
        """Compute the windows that have become known completely."""
        piece, kept = self._operand.out, self._kept
        if not len(piece.time):
            self.out = NOTHING
            return
        if self._done_ns is None:
            self._done_ns = int(piece.time[0])
        done, end = self._done_ns, max(self._done_ns, min(piece.end - self._end_ns, FAR_NS))
        whole = join(kept, piece)
        if end > done:
            moments = self._moments(whole, done, end)
            first = whole.time.searchsorted(moments + self._begin_ns, "right") - 1
            last = whole.time.searchsorted(moments + self._end_ns, "right") - 1
            np.maximum(first, 0, out=first)
            low = self._extrema(whole.low, len(kept.time), first, last)
            high = low if whole.high is whole.low else self._extrema(whole.high, len(kept.time), first, last)
            self.out = Piece(moments, low, high, end)
            self._done_ns = end
            whole = cut(whole, max(end + self._begin_ns, int(whole.time[0])))
        else:
            self.out = NOTHING
        self._kept = self._deciding(whole)

    def _moments(self, whole: Piece, done: int, end: int) -> Times:
        """Return the moments from ``done`` to ``end`` at which a value enters or leaves the window."""
        changes = np.concatenate(([done], whole.time - self._end_ns, whole.time[1:] - self._begin_ns))
        if self._begin_ns == self._end_ns:
            changes = changes[: len(whole.time) + 1]
        moments: Times = np.unique(changes[(changes >= done) & (changes < end)])
        return moments

    def _extrema(self, values: Values, kept: int, first: Times, last: Times) -> Values:
        """Return the extremum of ``values[first : last + 1]`` for each pair.

        Of the first ``kept`` values, each is already the extremum of itself and the kept values after it.
        """
        fresh = values[kept:]
        begin = np.maximum(first - kept, 0)
        length = last - kept - begin + 1
        found = np.full(len(first), self._neutral)
        level, table = 0, fresh
        longest = int(length.max())
        while 1 << level <= longest:  # `table` has the extrema of 2**level values each
            chosen = (length >> level) == 1
            if chosen.any():
                start = begin[chosen]
                rest = last[chosen] - kept + 1 - (1 << level)
                found[chosen] = self._function(table[start], table[rest])
            level += 1
            if 1 << level <= longest:
                half = 1 << (level - 1)
                table = self._function(table[:-half], table[half:])
        if kept:
            old = first < kept
            found[old] = self._function(found[old], values[first[old]])
        return found

    def _deciding(self, whole: Piece) -> Piece:
        """Return what can decide a future result; see the class."""
        if len(whole.time) < 2:
            return whole
        low = self._function.accumulate(whole.low[::-1])[::-1]
        changed = low[1:] != low[:-1]
        if whole.high is whole.low:
            keep = np.concatenate(([True], changed))
            low = low[keep]
            return Piece(whole.time[keep], low, low, whole.end)
        high = self._function.accumulate(whole.high[::-1])[::-1]
        keep = np.concatenate(([True], changed | (high[1:] != high[:-1])))
        return Piece(whole.time[keep], low[keep], high[keep], whole.end)


class History(Node):
    """The greatest or the least value of a signal from the start of the judged time up to each moment."""

    def __init__(self, function: np.ufunc, operand: Node) -> None:
        self._function = function
        self._operand = operand
        self._neutral = -np.inf if function is np.maximum else np.inf
        self._before: tuple[float, float] = (self._neutral, self._neutral)

    def turn(self) -> None:
        """Extend the greatest or the least value with the new values."""
        time, low, high, end = self._operand.out
        if not len(time):
            self.out = NOTHING
            return
        known = high is low and self._before[0] == self._before[1]
        low = self._function(self._function.accumulate(low), self._before[0])
        high = low if known else self._function(self._function.accumulate(high), self._before[1])
        self._before = float(low[-1]), float(high[-1])
        self.out = Piece(time, low, high, end)


UNTIL_SHARE: Final = 8
"""The :class:`Until` node computes only when at least one in this many of its values is new."""


class Until(Node):
    """Whether, at each t, ``right`` is true at a moment s in [t + begin, t + end], and ``left`` from t until s.

    The value is the greatest, over all such s, of the least of ``right`` at s and of ``left`` from
    t up to s, exclusive. The node computes its whole window anew. It therefore waits until one in
    :data:`UNTIL_SHARE` of the values is new.
    """

    def __init__(self, left: Node, right: Node, begin_ns: int, end_ns: int) -> None:
        self._operands = (left, right)
        self._alignment = Alignment(2)
        self._begin_ns, self._end_ns = begin_ns, end_ns
        self._kept = (NOTHING, NOTHING)
        self._fresh = 0  # number of values since the last computation
        self._done_ns: int | None = None

    def turn(self) -> None:
        """Compute the windows that have become known completely, once enough values are new."""
        left, right = self._alignment.align([operand.out for operand in self._operands])
        if not len(left.time):
            self.out = NOTHING
            return
        if self._done_ns is None:
            self._done_ns = int(left.time[0])
        self._fresh += len(left.time)
        left, right = join(self._kept[0], left), join(self._kept[1], right)
        if self._fresh * UNTIL_SHARE < len(left.time) and left.end < FAR_NS // 2:
            self._kept, self.out = (left, right), NOTHING
            return
        self._fresh = 0
        done, end = self._done_ns, max(self._done_ns, min(left.end - self._end_ns, FAR_NS))
        self.out = NOTHING
        if end > done:
            changes = np.concatenate(([done], left.time, left.time - self._end_ns, left.time - self._begin_ns))
            moments = np.unique(changes[(changes >= done) & (changes < end)])
            here, first, last = (
                left.time.searchsorted(moments + shift, "right") - 1 for shift in (0, self._begin_ns, self._end_ns)
            )
            inside = left.time[first] < moments + self._begin_ns  # `left` must also hold there, before the window
            before = first + inside - here
            low = _until(left.low, right.low, here, before, first, last)
            known = left.high is left.low and right.high is right.low
            high = low if known else _until(left.high, right.high, here, before, first, last)
            self.out = Piece(moments, low, high, end)
            self._done_ns = end
            left, right = cut(left, end), cut(right, end)
        self._kept = left, right


def _until(left: Values, right: Values, here: Times, before: Times, first: Times, last: Times) -> Values:
    """Return the value of ``until`` at several moments.

    Each value of the signals turns the result x of the values after it into max(p, min(q, x)), where
    p is ``right`` and q is ``left``. Two such functions in sequence are again one such function. So
    :func:`_continue` combines them in blocks of 2**level, and each window uses the blocks that make
    up its length.

    Args:
        left: The values of the left operand.
        right: The values of the right operand.
        here: The index of the value at each moment.
        before: The number of values from there to the start of the window; for these, p is minus
            infinity.
        first: The index of the first value of each window.
        last: The index of the last value of each window.
    """
    false = np.full(len(left), -np.inf)
    found = np.full(len(here), -np.inf), np.full(len(here), np.inf)
    _continue(found, false, left, here, before)
    _continue(found, right, left, first, last - first + 1)
    return found[0]


def _continue(found: tuple[Values, Values], p: Values, q: Values, begin: Times, length: Times) -> None:
    """Append to each function x → max(p, min(q, x)) in ``found`` the ``length`` functions from ``begin`` on."""
    found_p, found_q = found
    place, level = begin.copy(), 0
    while (length >> level).any():
        odd = (length >> level & 1).astype(bool)
        next_p, next_q = p[place[odd]], q[place[odd]]
        found_p[odd] = np.maximum(found_p[odd], np.minimum(found_q[odd], next_p))
        found_q[odd] = np.minimum(found_q[odd], next_q)
        half = 1 << level
        place[odd] += half
        p, q = np.maximum(p[:-half], np.minimum(q[:-half], p[half:])), np.minimum(q[:-half], q[half:])
        level += 1


class Tube(Node):
    """How far a number is inside the band between two limits; negative if it is outside.

    Args:
        operand: The number.
        lower: The lower limit. Its times count from the start of the judged time.
        upper: The upper limit. Its times count in the same way.
        base: What was subtracted from the limits, so that large integers are exact.
    """

    def __init__(self, operand: Node, lower: Piece, upper: Piece, base: Exact = 0) -> None:
        self._operand = operand
        self._base = base
        self._limits = lower, upper
        self._begun = False

    @property
    def limits(self) -> tuple[Piece, Piece]:
        """The limits; once the judged time has begun, with times of the instance's clock."""
        lower, upper = (
            limit._replace(low=limit.low + float(self._base), high=limit.high + float(self._base))
            for limit in self._limits
        )
        return lower, upper

    def turn(self) -> None:
        """Compare the number with the limits at each moment."""
        piece = self._operand.out
        if not len(piece.time):
            self.out = NOTHING
            return
        if not self._begun:
            self._begun = True
            begin = int(piece.time[0])
            self._limits = tuple(limit._replace(time=limit.time + begin) for limit in self._limits)  # type: ignore[assignment]
        inner = [
            limit.time[limit.time.searchsorted(piece.time[0], "right") : limit.time.searchsorted(piece.end)]
            for limit in self._limits
        ]
        time = np.unique(np.concatenate((piece.time, *inner)))
        values = piece.low[piece.time.searchsorted(time, "right") - 1]
        least, greatest = bounds(EXACTLY[SUBTRACT](values, self._base) if self._base else values)
        below, above = (limit.time.searchsorted(time, "right") - 1 for limit in self._limits)
        lower, upper = self._limits
        low = _loose(np.minimum(least - lower.high[below], upper.low[above] - greatest))
        high = _loose(np.minimum(greatest - lower.low[below], upper.high[above] - least))
        unknown = np.isnan(least)
        low[unknown], high[unknown] = -np.inf, np.inf
        self.out = Piece(time, low, high, piece.end)


def tube(golden: Piece, tolerance: float, tolerance_ns: int) -> tuple[Piece, Piece, Exact]:
    """Return the lower and the upper limit of the band around a signal, less a base, and this base.

    The base is 0, or the signal's largest value if the signal has integers that floats cannot represent.

    Before its start, the signal counts as having its first value; after its end, its last value.

    Args:
        golden: The signal, up to :data:`FAR_NS`; NaN where it is unknown.
        tolerance: Tolerance of the value.
        tolerance_ns: Tolerance in time, in both directions.
    """
    unknown = np.isnan(floats(golden.low))
    base: Exact = 0
    if is_exact(golden.low):
        base = max(golden.low[~unknown].tolist(), key=abs)
    low, high = bounds(EXACTLY[SUBTRACT](golden.low, base) if base else golden.low)
    time = golden.time.copy()
    time[-1] += tolerance_ns
    values = Input()
    values.out = Piece(time, low=np.where(unknown, -np.inf, low), high=np.where(unknown, np.inf, high), end=golden.end)
    limits = []
    for function, more in ((np.minimum, -tolerance), (np.maximum, tolerance)):
        window = Window(function, values, -tolerance_ns, tolerance_ns)
        window.turn()
        found = window.out
        limits.append(Piece(found.time, _sum(found.low, more, -np.inf), _sum(found.high, more, np.inf), found.end))
    return limits[0], limits[1], base


def _sum(values: Values, more: float, towards: float) -> Values:
    """Return sums; a sum of large numbers, which floats cannot represent, is rounded in a direction."""
    found = values + more
    with np.errstate(invalid="ignore"):  # infinity less infinity
        lost = (np.abs(found) >= WHOLE) & np.isfinite(found) & (found - values != more)
    return np.where(lost, np.nextafter(found, towards), found)


# -- functions of numbers ----------------------------------------------------------------------------------------------


def _strict(distance: Values) -> Values:
    """Return distances that count as false where they were 0."""
    return np.where(distance == 0, -TINY, distance)


def _loose(distance: Values) -> Values:
    """Return distances that count as true where they were 0."""
    return np.where(distance == 0, TINY, distance)


def _binary(operation: int, function: Numeric) -> Numeric:
    """Return a function that computes exactly if an operand is exact; see :mod:`shmio.injection.exact`."""

    def compute(left: Values, right: Values) -> Values:
        return (EXACTLY[operation] if is_exact(left) or is_exact(right) else function)(left, right)

    return compute


_difference: Final = _binary(SUBTRACT, np.subtract)


def _distance(left: Values, right: Values) -> Values:
    """Return how far numbers are from others; only an equal number has the distance 0."""
    return floats(_difference(left, right))


COMPARISONS: Final[dict[str, Numeric]] = {
    "==": lambda left, right: _loose(-np.abs(_distance(left, right))),
    "!=": lambda left, right: _strict(np.abs(_distance(left, right))),
    "<": lambda left, right: _strict(_distance(right, left)),
    "<=": lambda left, right: _loose(_distance(right, left)),
    ">": lambda left, right: _strict(_distance(left, right)),
    ">=": lambda left, right: _loose(_distance(left, right)),
}


def _quotient(left: Values, right: Values) -> Values:
    return np.where(np.equal(right, 0), np.nan, np.divide(left, right))


NUMBERS: Final[dict[str, Numeric]] = {
    "+": _binary(ADD, np.add),
    "-": _difference,
    "*": _binary(MULTIPLY, np.multiply),
    "/": _binary(DIVIDE, _quotient),
    "mod": _binary(MODULO, np.mod),
    "neg": np.negative,
    "abs": np.abs,
}
OF_INTEGERS: Final[dict[str, Numeric]] = {
    "+": EXACTLY[ADD],
    "-": EXACTLY[SUBTRACT],
    "*": EXACTLY[MULTIPLY],
}
"""The functions of integers whose results are integers, which may be larger than the operands."""


def from_bool(values: Values) -> Values:
    """Return the truths of BOOLs, given as 1 and 0: 1 is true, -1 is false."""
    return 2.0 * values - 1.0


def from_number(values: Values) -> Values:
    """Return the truths of numbers: a number is true if it is not 0."""
    return _strict(np.abs(floats(values)))
