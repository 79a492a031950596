from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.recording.decimation import Decimator, Samples


def samples(values: Sequence[float], first: int = 0, injected: Sequence[int] = ()) -> Samples:
    time_ns = np.arange(first, first + len(values), dtype=np.int64)
    return Samples(time_ns, np.array(values, np.float64), np.isin(time_ns, injected))


def reduced(values: Sequence[float], columns: int, cuts: Sequence[int] = (), injected: Sequence[int] = ()) -> Samples:
    """Reduce samples at 0, 1, 2… ns; the parts begin at ``cuts``."""
    decimator = Decimator(0, len(values), columns)
    bounds = [0, *sorted(cuts), len(values)]
    parts = [decimator.add(samples(values[at:to], at, injected)) for at, to in pairwise(bounds)]
    parts.append(decimator.end())
    return Samples(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def test_least_and_greatest_of_a_column_remain_at_their_times() -> None:
    found = reduced([5, 1, 5, 9, 5, 5, 5, 5, 5, 5], 1)
    assert found.time_ns.tolist() == [0, 1, 3, 9]
    assert found.values.tolist() == [5, 1, 9, 5]


def test_all_samples_remain_if_each_has_a_column() -> None:
    assert reduced([3, 1, 2], 3).values.tolist() == [3, 1, 2]


def test_a_single_sample_without_value_and_an_injected_one_remain() -> None:
    values = [1.0] * 100
    values[40] = math.nan
    found = reduced(values, 1, injected=[60])
    assert found.time_ns.tolist() == [0, 40, 60, 99]
    assert found.injected.tolist() == [False, False, True, False]
    assert math.isnan(found.values[1])


def test_a_column_without_values_is_a_gap() -> None:
    found = reduced([1, 1, math.nan, math.nan, 2, 2], 3)
    assert np.isnan(found.values[(found.time_ns >= 2) & (found.time_ns < 4)]).all()


@given(
    st.lists(st.floats(width=16), min_size=1, max_size=60),
    st.integers(1, 20),
    st.lists(st.integers(0, 60), max_size=5),
)
def test_parts_give_the_same_as_the_whole(values: list[float], columns: int, cuts: list[int]) -> None:
    cuts = [min(cut, len(values)) for cut in cuts]
    whole, parts = reduced(values, columns), reduced(values, columns, cuts)
    assert parts.time_ns.tolist() == whole.time_ns.tolist()
    good = [value for value in values if not math.isnan(value)]
    if good:
        assert (np.nanmin(whole.values), np.nanmax(whole.values)) == pytest.approx((min(good), max(good)))
    assert len(whole.time_ns) <= 6 * (columns + 1) + 6
