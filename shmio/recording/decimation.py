"""Reduces the samples of a register to those that a plot of a certain width can show."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt


class Samples(NamedTuple):
    """Samples in the order of time, arrays of shape (n,).

    Attributes:
        time_ns: Times in ns, int64.
        values: Values, float64; NaN where there is no good value.
        injected: True where a value is injected, bool.
    """

    time_ns: npt.NDArray[np.int64]
    values: npt.NDArray[np.float64]
    injected: npt.NDArray[np.bool_]

    def take(self, chosen: Any) -> Samples:
        """Return the samples that a numpy index or mask selects."""
        return Samples(self.time_ns[chosen], self.values[chosen], self.injected[chosen])


NO_SAMPLES = Samples(np.empty(0, np.int64), np.empty(0, np.float64), np.empty(0, np.bool_))


def joined(first: Samples, second: Samples) -> Samples:
    """Return the samples of ``first``, followed by those of ``second``."""
    return Samples(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


class Decimator:
    """Reduces samples that are added in parts, in the order of time.

    Time is divided into columns, such as the pixels of a plot. From each column, the decimator
    keeps the first and the last sample, those with the least and the greatest value, the first
    sample without a good value, and the first injected sample. A plot of these samples looks like a
    plot of all samples.
    """

    def __init__(self, begin_ns: int, end_ns: int, columns: int) -> None:
        """Divide the time from ``begin_ns`` to ``end_ns`` into columns."""
        self._begin_ns = begin_ns
        self._width_ns = max(1, (end_ns - begin_ns) // max(1, columns))
        self._rest = NO_SAMPLES
        self.reduced = False
        """True if any sample was left out so far."""

    def add(self, samples: Samples) -> Samples:
        """Add the next samples. Return the kept samples of all columns that are now complete."""
        whole = joined(self._rest, samples)
        if not len(whole.time_ns):
            return NO_SAMPLES
        column = (whole.time_ns - self._begin_ns) // self._width_ns
        kept = _kept(whole, column)
        self.reduced |= len(kept) < len(column)
        whole, column = whole.take(kept), column[kept]
        complete = column != column[-1]
        self._rest = whole.take(~complete)
        return whole.take(complete)

    def end(self) -> Samples:
        """Return the kept samples of the last column."""
        rest, self._rest = self._rest, NO_SAMPLES
        return rest


def _kept(samples: Samples, column: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
    """Return the indices of the samples to keep."""
    changes = np.flatnonzero(column[1:] != column[:-1]) + 1
    starts = np.concatenate(([0], changes))
    ends = np.concatenate((changes, [len(column)]))
    sizes = ends - starts
    group = np.repeat(np.arange(len(starts)), sizes)
    bad = np.isnan(samples.values)
    least = np.repeat(np.minimum.reduceat(np.where(bad, np.inf, samples.values), starts), sizes)
    greatest = np.repeat(np.maximum.reduceat(np.where(bad, -np.inf, samples.values), starts), sizes)
    masks = (samples.values == least, samples.values == greatest, bad, samples.injected)
    chosen = (starts, ends - 1, *(_firsts(mask, group) for mask in masks))
    kept: npt.NDArray[np.intp] = np.unique(np.concatenate(chosen))
    return kept


def _firsts(mask: npt.NDArray[np.bool_], group: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return the index of the first sample of each group that a mask selects."""
    found: npt.NDArray[np.intp] = np.flatnonzero(mask)
    of = group[found]
    return found[np.concatenate(([True], of[1:] != of[:-1]))] if len(found) else found
