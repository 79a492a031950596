"""Equal steps, writes, injections and seeds give the same bytes on every stream."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import pytest

from shmio.testing.cell import Cell, kill, until
from shmio.wire import simlog_v2_pb2 as v2
from tests.system.campaign import CONFIG, J1, J2, NOISY, PANEL, SLOW_S, STEPS, Streams, run

BURNERS = 4
BURN = "while True: pass"


@pytest.fixture
def cell(make_cell: Callable[..., Cell]) -> Cell:
    """Write a cell with models, noise and a memory, with time at 0. It is not running."""
    cell = make_cell(config=CONFIG)
    (cell.folder / "panel.toml").write_text(PANEL)
    (cell.folder / "noisy.py").write_text(NOISY)
    return cell


def good(cell: Cell) -> bool:
    return all(cell.processes()[name]["quality"] == "good" for name in ("sim", "noise", "panel"))


def campaign(
    cell: Cell,
    *,
    pause_s: float = 0.0,
    before: Callable[[Cell], None] = lambda _: None,
    beside: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> Streams:
    """Start the cell, run the campaign, and stop the cell. Return the messages of each stream."""
    cell.up()
    until(lambda: good(cell), "good quality")
    before(cell)
    with beside():
        streams = asyncio.run(run(cell.instance, str(cell.grpc), pause_s=pause_s))
    cell.down()
    return streams


@contextmanager
def load() -> Iterator[None]:
    """Keep more processes busy than the host has processors."""
    burners = [subprocess.Popen([sys.executable, "-c", BURN]) for _ in range(BURNERS)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def restarted(cell: Cell) -> None:
    """Kill every process but the supervisor, and wait until their successors work."""
    before = {name: process["pid"] for name, process in cell.processes().items()}
    for pid in before.values():
        kill(pid)
    until(lambda: all(cell.processes()[name]["pid"] not in (pid, None) for name, pid in before.items()), "successors")
    until(lambda: good(cell) and cell.processes()["grpc"]["state"] == "running", "good quality again")


def assert_same(first: Streams, second: Streams) -> None:
    assert first.keys() == second.keys()
    for name, messages in first.items():
        for number, (one, other) in enumerate(zip(messages, second[name], strict=False)):
            assert one == other, f"{name}: message {number}"
        assert len(messages) == len(second[name]), name


@pytest.mark.timeout(300)
def test_a_campaign_repeats_exactly(cell: Cell) -> None:
    first = campaign(cell)
    assert_same(first, campaign(cell, before=restarted, beside=load, pause_s=SLOW_S))
    # Check that the compared streams contain what the campaign does.
    two = [v2.SimlogMessage.FromString(message) for message in first["v2 two"]]
    assert [m.value.number_value for m in two if m.header.path == "SIMLOG://step"] == list(range(1, STEPS + 1))
    assert {"joints/Kuka.j1/R", "/sim/joints/Kuka.j1/R", "panel/lamps", "noise/glitches/20"} < {
        m.header.path for m in two
    }
    assert len(first["v1 noise/measured"]) == STEPS + 1
    assert len(first["shmio.v1"]) > 2 * STEPS
    assert -20.0 in [m.value.number_value for m in two if m.header.path == J1], "the injected value"
    second_joint = [m.value.number_value for m in two if m.header.path == J2]
    assert any(value not in (0.0, *(1 / n for n in range(1, STEPS, 2))) for value in second_joint), (
        "values of the declared injection"
    )
