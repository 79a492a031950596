"""A set of numbers as ranges."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shmio.fabric.archive.numbers import MAX_RANGES, NumberSet


@given(st.lists(st.integers(1, 60)))
def test_it_behaves_as_a_set(numbers: list[int]) -> None:
    seen: set[int] = set()
    found = NumberSet()
    for number in numbers:
        assert found.add(number) == (number not in seen)
        seen.add(number)
    assert {one for first, last in found.ranges for one in range(first, last + 1)} == seen
    assert all(two[0] > one[1] + 1 for one, two in zip(found.ranges, found.ranges[1:], strict=False))
    assert NumberSet(found.ranges).ranges == found.ranges


def test_the_oldest_hole_is_filled_when_there_are_too_many() -> None:
    found = NumberSet()
    for number in range(1, 2 * MAX_RANGES + 2, 2):
        found.add(number)
    assert len(found.ranges) == MAX_RANGES
    assert not found.add(2)
    assert found.add(4)
