"""The schedule of an emulated device's program."""

from __future__ import annotations

import itertools
import threading
import time

import pytest

from shmio.emulators.cycle import Cycle
from shmio.testing.cell import until

STEP_S = 0.02


def test_a_program_that_is_too_slow_leaves_half_of_the_time() -> None:
    times: list[tuple[float, float]] = []
    never = threading.Event()

    def step(_: float) -> None:
        begun_s = time.monotonic()
        never.wait(STEP_S)
        times.append((begun_s, time.monotonic()))

    cycle = Cycle(STEP_S / 4, step, "slow")
    cycle.start()
    until(lambda: len(times) > 5, "six steps")
    cycle.stop()
    pauses = [later[0] - before[1] for before, later in itertools.pairwise(times)]
    assert min(pauses) > 0.9 * STEP_S
    assert cycle.overruns >= 5


def test_a_frozen_program_runs_only_the_scans_that_are_due() -> None:
    times: list[float] = []
    cycle = Cycle(0.01, times.append, "frozen")
    cycle.freeze()
    cycle.first()
    cycle.start()
    cycle.advance(9_000_000)
    assert times == [0]
    cycle.advance(1_000_000)
    cycle.advance(25_000_000)
    cycle.advance(5_000_000)
    assert times == [0] + [pytest.approx(number * 0.01) for number in (1, 2, 3, 4)]
    cycle.thaw()
    until(lambda: len(times) > 6, "scans by the schedule")
    cycle.freeze()
    seen = len(times)
    cycle.advance(10_000_000)
    assert times[seen] - times[seen - 1] == pytest.approx(0.01)
    cycle.stop()


def test_an_error_of_a_frozen_program_ends_its_scans() -> None:
    calls: list[float] = []

    def fail(time_s: float) -> None:
        calls.append(time_s)
        raise ZeroDivisionError

    cycle = Cycle(0.01, fail, "failing")
    cycle.freeze()
    cycle.advance(100_000_000)
    assert len(calls) == 1
    assert isinstance(cycle.failure, ZeroDivisionError)
