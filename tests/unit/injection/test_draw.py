"""Random numbers that depend only on a seed and a position."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.injection._numbers import uniform
from shmio.injection.draw import FEW, Purpose, SeededRandom

places = st.integers(0, 2**40)


def test_numbers_are_the_same_in_every_version() -> None:
    """A campaign recorded with one version of shmio can be repeated with the next version."""
    words = SeededRandom(7, "drift").words(1, 12, Purpose.VALUE, 3)
    assert [f"{word:016x}" for word in words.tolist()] == ["c5b32a2bd6d0f3ce", "20657407695298c2", "a78378d3780506af"]


@given(st.integers(0, 2**63 - 1), places, places)
def test_numbers_of_a_place_do_not_depend_on_the_order_of_calls(seed: int, run: int, place: int) -> None:
    one, other = SeededRandom(seed, "a"), SeededRandom(seed, "a")
    later = other.uniform(run, place + 1, 4)
    assert one.uniform(run, place, 8).tolist() == other.uniform(run, place, 8).tolist()
    assert one.uniform(run, place, 8)[:3].tolist() == other.uniform(run, place, 3).tolist()
    assert one.uniform(run, place + 1, 4).tolist() == later.tolist()


@given(st.integers(0), st.integers(0, 2**64), st.integers(-100, 100) | places, st.sampled_from(Purpose))
def test_a_single_number_is_that_of_an_array(seed: int, run: int, place: int, purpose: Purpose) -> None:
    draw = SeededRandom(seed, "x")
    assert uniform(draw.key, run, place, purpose) == draw.uniform(run, place, 1, purpose)[0]


def test_each_seed_name_activation_place_and_purpose_has_its_own_numbers() -> None:
    found = [
        SeededRandom(seed, name).words(run, place, purpose, 1)[0]
        for seed in (0, 1) for name in ("a", "b") for run in (1, 2) for place in (0, 1) for purpose in Purpose
    ]  # fmt: skip
    assert len(set(found)) == len(found)


@given(st.integers(0, 2**32), places)
def test_numbers_are_within_their_range(seed: int, place: int) -> None:
    draw = SeededRandom(seed, "x")
    uniform = draw.uniform(1, place, 50)
    assert ((uniform >= 0) & (uniform < 1)).all()
    assert np.isfinite(draw.gaussian(1, place, 50)).all()
    below = draw.below(3, 1, place, 50)
    assert ((below >= 0) & (below < 3)).all()
    assert draw.happens(1, 1, place)


def test_statistics_of_the_distributions() -> None:
    draw = SeededRandom(1, "x")
    uniform = np.concatenate([draw.uniform(1, place, 100) for place in range(1000)])
    assert uniform.mean() == pytest.approx(0.5, abs=0.005)
    assert uniform.var() == pytest.approx(1 / 12, abs=0.002)
    normal = np.concatenate([draw.gaussian(1, place, 100) for place in range(1000)])
    assert normal.mean() == pytest.approx(0, abs=0.02)
    assert normal.std() == pytest.approx(1, abs=0.01)
    assert np.mean(np.abs(normal) < 1) == pytest.approx(0.6827, abs=0.005)
    assert np.corrcoef(normal[:-1], normal[1:])[0, 1] == pytest.approx(0, abs=0.02)
    assert np.mean([draw.happens(0.25, 1, place) for place in range(10_000)]) == pytest.approx(0.25, abs=0.015)
    counts = np.bincount(np.concatenate([draw.below(4, 1, place, 50) for place in range(1000)]))
    assert counts == pytest.approx(12_500, rel=0.05)


@given(st.integers(0, 2**32), places)
def test_short_sequence_is_the_beginning_of_a_longer_one(seed: int, place: int) -> None:
    draw = SeededRandom(seed, "x")
    for purpose in Purpose:
        assert draw.words(3, place, purpose, FEW).tolist() == draw.words(3, place, purpose, FEW + 1)[:FEW].tolist()
    assert draw.uniform(3, place, FEW).tolist() == draw.uniform(3, place, FEW + 1)[:FEW].tolist()
    assert draw.gaussian(3, place, FEW) == pytest.approx(draw.gaussian(3, place, FEW + 1)[:FEW], rel=1e-12)
