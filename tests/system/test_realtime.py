"""A cell whose source has a real-time priority."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest

from shmio.testing.cell import CONFIG, Cell, may_be_realtime


@pytest.mark.skipif(not may_be_realtime(), reason="this user may have no real-time priority")
def test_only_the_process_of_the_source_has_the_priority(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=CONFIG.replace('connector = "s7"', 'connector = "s7"\nrealtime_priority = 2'))
    cell.up()
    policies = {process["name"]: os.sched_getscheduler(process["pid"]) for process in cell.status()["processes"]}
    assert policies.pop("cell") == os.SCHED_FIFO
    assert os.SCHED_FIFO not in policies.values()
