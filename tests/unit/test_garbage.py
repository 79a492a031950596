"""Garbage collection while a process starts."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from shmio import garbage


@pytest.fixture(autouse=True)
def collection() -> Iterator[None]:
    """Enable the collector, which an earlier test of a worker may have paused, and restore its state."""
    gc.enable()
    yield
    gc.enable()
    gc.freeze()  # as tests/conftest.py does


def test_nothing_is_collected_during_the_start_and_only_new_objects_after_it() -> None:
    garbage.pause()
    assert not gc.isenabled()
    kept: list[list[int]] = [[]]
    garbage.resume()
    assert gc.isenabled()
    assert all(one is not kept for one in gc.get_objects())
    assert gc.get_freeze_count() > 0


def test_without_a_pause_nothing_is_frozen() -> None:
    kept: list[list[int]] = [[]]
    garbage.resume()
    assert gc.isenabled()
    assert any(one is kept for one in gc.get_objects()), "frozen objects are not among them"


def test_nothing_is_collected_in_a_block_and_everything_after_it() -> None:
    with garbage.paused():
        assert not gc.isenabled()
        kept: list[list[int]] = [[]]
    assert gc.isenabled()
    assert any(one is kept for one in gc.get_objects()), "frozen objects are not among them"
    gc.disable()
    with garbage.paused():
        pass
    assert not gc.isenabled()
