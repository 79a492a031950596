"""Pieces of signals. A signal's value is constant between the times at which it changes.

A signal is a number or a degree of truth for each moment of the judged time. An unknown number is
NaN. A degree of truth is an interval from ``low`` to ``high``: positive is true, negative is false,
and the distance from zero is the robustness. Both bounds are equal where everything is known. An
unknown truth reaches from minus to plus infinity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

Times = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

FAR_NS: Final = 1 << 61
"""A time in ns that is later than any judged time. From the end of the run to this time, all values are unknown."""
TINY: Final = 5e-324
"""The smallest positive number. A truth whose distance is 0 has this value: positive if it is true, else negative."""


class Piece(NamedTuple):
    """A part of a signal, from ``time[0]`` to ``end``.

    Attributes:
        time: The moments from which the values hold, in ns, strictly ascending, int64, shape (n,).
        low: The numbers, or the lower bounds of the truths; float64, shape (n,).
        high: The upper bounds of the truths. For numbers, or if nothing is unknown, the same object
            as ``low``.
        end: The moment, in ns, at which the last value ends, exclusive.
    """

    time: Times
    low: Values
    high: Values
    end: int


NO_TIMES: Final = np.empty(0, np.int64)
NO_VALUES: Final = np.empty(0, np.float64)
NOTHING: Final = Piece(NO_TIMES, NO_VALUES, NO_VALUES, 0)


def join(first: Piece, second: Piece) -> Piece:
    """Join two consecutive pieces. Either may be empty."""
    if not len(first.time):
        return second
    if not len(second.time):
        return first
    low = np.concatenate((first.low, second.low))
    known = first.high is first.low and second.high is second.low
    high = low if known else np.concatenate((first.high, second.high))
    return Piece(np.concatenate((first.time, second.time)), low, high, second.end)


def cut(piece: Piece, at_ns: int) -> Piece:
    """Return the part of a piece from ``at_ns`` on; empty if the piece has ended by then.

    ``at_ns`` must not be before the piece's start.
    """
    if at_ns >= piece.end:
        return NOTHING
    first = int(piece.time.searchsorted(at_ns, "right")) - 1
    time, low = piece.time[first:], piece.low[first:]
    if time[0] != at_ns:
        time = time.copy()
        time[0] = at_ns
    return Piece(time, low, low if piece.high is piece.low else piece.high[first:], piece.end)


def head(piece: Piece, until_ns: int) -> Piece:
    """Return the part of a piece before ``until_ns``; empty if the piece starts later."""
    if until_ns >= piece.end:
        return piece
    count = int(piece.time.searchsorted(until_ns))
    if not count:
        return NOTHING
    low = piece.low[:count]
    return Piece(piece.time[:count], low, low if piece.high is piece.low else piece.high[:count], until_ns)


class Alignment:
    """Gives the pieces of several signals the same times.

    It keeps the parts that are not yet known for all signals.
    """

    def __init__(self, count: int) -> None:
        self._rests = [NOTHING] * count

    def align(self, pieces: Sequence[Piece]) -> list[Piece]:
        """Add the next piece of each signal, and return the part that is known for all signals.

        All returned pieces have the same times and the same end.
        """
        first = pieces[0]
        if all(piece.time is first.time and piece.end == first.end for piece in pieces) and not any(
            len(rest.time) for rest in self._rests
        ):
            return list(pieces)
        whole = [join(rest, piece) for rest, piece in zip(self._rests, pieces, strict=True)]
        if not all(len(piece.time) for piece in whole):
            self._rests = whole
            return [NOTHING] * len(whole)
        end = min(piece.end for piece in whole)
        self._rests = [cut(piece, end) for piece in whole]
        heads = [head(piece, end) for piece in whole]
        time = np.unique(np.concatenate([piece.time for piece in heads]))
        return [_at(piece, time) for piece in heads]


def _at(piece: Piece, time: Times) -> Piece:
    """Return a piece with its values at the moments in ``time``, which include its own."""
    if len(piece.time) == len(time):
        return piece._replace(time=time)
    index = piece.time.searchsorted(time, "right") - 1
    low = piece.low[index]
    return Piece(time, low, low if piece.high is piece.low else piece.high[index], piece.end)
