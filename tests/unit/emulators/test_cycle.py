"""The schedule of an emulated device's program."""

from __future__ import annotations

import itertools
import threading
import time

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
