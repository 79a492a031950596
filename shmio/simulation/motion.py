"""The motion of axes: along poses at given times, without jerks, and never quite still."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence

Pose = tuple[float, ...]

_BREATH_PERIOD_S = 2.2
_BREATH_SPREAD_S = 0.31  # between neighbouring axes, so that they do not move in step


def smooth(u: float) -> float:
    """Return a smooth step from 0 to 1: at rest at both ends, clamped outside."""
    u = min(max(u, 0.0), 1.0)
    return u * u * (3 - 2 * u)


class Track:
    """A cyclic path of several axes. Between key poses all axes start and stop together.

    A slow sine on top of ``smooth``, the play of a servo loop, changes the value of an axis at rest
    too.
    """

    def __init__(self, keys: Sequence[tuple[float, Pose]], cycle_s: float, breath: float) -> None:
        """Create the track.

        Args:
            keys: Times in the cycle in s with their key poses, in order; the last leads to the
                first of the next cycle.
            cycle_s: The length of the cycle in s.
            breath: The amplitude of the sine, in the unit of the axes.

        """
        first_s, first = keys[0]
        self._cycle_s = cycle_s
        self._times = [time_s for time_s, _ in keys] + [first_s + cycle_s]
        self._poses = [pose for _, pose in keys] + [first]
        self._breath = breath

    def rest(self, time_s: float) -> Pose | None:
        """Return the key pose at which the axes rest; None while they move."""
        index, _ = self._place(time_s)
        return self._poses[index] if self._poses[index] == self._poses[index + 1] else None

    def pose(self, time_s: float) -> Pose:
        """Return the position of each axis."""
        index, u = self._place(time_s)
        share = smooth(u)
        return tuple(
            start + (end - start) * share + self._sine(time_s, axis)
            for axis, (start, end) in enumerate(zip(self._poses[index], self._poses[index + 1], strict=True))
        )

    def _place(self, time_s: float) -> tuple[int, float]:
        """Return the index of the last key, and the progress to the next one, 0 to 1."""
        phase_s = (time_s - self._times[0]) % self._cycle_s + self._times[0]
        index = min(bisect_right(self._times, phase_s), len(self._times) - 1) - 1
        begun_s, ends_s = self._times[index], self._times[index + 1]
        return index, (phase_s - begun_s) / (ends_s - begun_s)

    def _sine(self, time_s: float, axis: int) -> float:
        return self._breath * math.sin(2 * math.pi * time_s / (_BREATH_PERIOD_S + axis * _BREATH_SPREAD_S))
