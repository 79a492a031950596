"""A set of numbers that mostly follow each other, as ranges."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import Final

MAX_RANGES: Final = 1000
"""Maximum number of ranges. Beyond it, the oldest hole counts as filled."""


class NumberSet:
    """A set of positive integers."""

    def __init__(self, ranges: Sequence[tuple[int, int]] = ()) -> None:
        """Create the set; ``ranges`` are the first and last number of each range, in order."""
        self._ranges = list(ranges)

    @property
    def ranges(self) -> tuple[tuple[int, int], ...]:
        """The first and last number of each range, in order."""
        return tuple(self._ranges)

    def add(self, number: int) -> bool:
        """Add a number; return False if the set has it already."""
        ranges = self._ranges
        at = bisect_right(ranges, (number, number))  # the range before may contain it, or the range that begins there
        if at and number <= ranges[at - 1][1]:
            return False
        if at < len(ranges) and ranges[at][0] == number:
            return False
        first = last = number
        if at < len(ranges) and ranges[at][0] == number + 1:
            last = ranges.pop(at)[1]
        if at and ranges[at - 1][1] == number - 1:
            at -= 1
            first = ranges.pop(at)[0]
        ranges.insert(at, (first, last))
        if len(ranges) > MAX_RANGES:
            ranges[:2] = [(ranges[0][0], ranges[1][1])]
        return True
