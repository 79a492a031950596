"""Keeps the signals of a run for plots, in a limited amount of memory."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from shmio.judging.pieces import Times, Values
from shmio.judging.source import Rows, Signal

MAX_POINTS: Final = 2000
"""Maximum number of points of a plotted signal."""


class Plot(NamedTuple):
    """The data of a signal's plot: the least and the greatest value from each time to the next, shape (n,).

    Both are NaN if the value was unknown all that time.
    """

    time_ns: Times
    least: Values
    greatest: Values


class Traces:
    """Collects signals of a run for plots. When there are too many values, it joins neighbouring ones."""

    def __init__(self, signals: Mapping[str, Sequence[Signal]], chosen: Collection[Signal]) -> None:
        """Prepare to collect signals.

        Args:
            signals: The signals of each source, in the order of its rows.
            chosen: The signals to collect.
        """
        self._traces: dict[str, _Trace] = {}
        self._places: dict[str, list[int]] = {}
        self._index: dict[Signal, int] = {}
        for source, some in signals.items():
            places = [place for place, signal in enumerate(some) if signal in chosen]
            if places:
                self._places[source], self._traces[source] = places, _Trace(len(places))
                self._index |= {some[place]: index for index, place in enumerate(places)}

    def add(self, rows: Mapping[str, Rows]) -> None:
        """Add the values that :meth:`Judge.turn` returned."""
        for source, some in rows.items():
            if source in self._traces:
                self._traces[source].add(some._replace(values=some.values[self._places[source]]))

    def plot(self, signal: Signal) -> Plot:
        """Return the plot of a signal, which must be one of those to collect."""
        return self._traces[signal.source].plot(self._index[signal])


class _Trace:
    """The signals of one source. Each point stands for at most ``_each`` values."""

    def __init__(self, signals: int) -> None:
        self._each = 1
        self._points: _Points = np.empty(0, np.int64), np.empty((signals, 0)), np.empty((signals, 0))
        self._rows: list[Rows] = []
        self._waiting = 0

    def add(self, rows: Rows) -> None:
        """Add values. When there are many, they become points."""
        self._rows.append(rows)
        self._waiting += len(rows.time)
        if self._waiting >= MAX_POINTS // 2 * self._each:
            self._compress()

    def _compress(self) -> None:
        if not self._rows:
            return
        time = np.concatenate([rows.time for rows in self._rows])
        values = np.concatenate([rows.values for rows in self._rows], axis=1)
        self._rows, self._waiting = [], 0
        added = _joined((time, values, values), self._each)
        time, least, greatest = (np.concatenate(pair, axis=-1) for pair in zip(self._points, added, strict=True))
        self._points = time, least, greatest
        while len(self._points[0]) > MAX_POINTS:
            self._points = _joined(self._points, 2)
            self._each *= 2

    def plot(self, index: int) -> Plot:
        """Return the plot of a signal."""
        self._compress()
        time, least, greatest = self._points
        return Plot(time, least[index], greatest[index])


_Points = tuple[Times, Values, Values]


def _joined(points: _Points, count: int) -> _Points:
    """Join each ``count`` neighbouring points; the last ones may be fewer."""
    time, least, greatest = points
    if count == 1 or not len(time):
        return points
    begin = np.arange(0, len(time), count)
    return time[begin], np.fmin.reduceat(least, begin, axis=1), np.fmax.reduceat(greatest, begin, axis=1)


def compressed(time_ns: Times, least: Values, greatest: Values) -> Plot:
    """Return a plot of a whole signal, with at most :data:`MAX_POINTS` points.

    Args:
        time_ns: The times from which the values hold, in ns, shape (n,).
        least: The least value from each time to the next.
        greatest: The greatest value from each time to the next.
    """
    count = -(-len(time_ns) // MAX_POINTS)
    time, low, high = _joined((time_ns, least[None, :], greatest[None, :]), count)
    return Plot(time, low[0], high[0])
