"""The running A50 cell, seen by another process and by the user's commands."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from shmio.testing.cell import Cell, until
from tests.system.test_cell import AXIS, five_values


@pytest.fixture(scope="module")
def running(make_shared_cell: Callable[..., Cell]) -> Cell:
    """Start the A50 cell, for tests that change nothing."""
    cell = make_shared_cell()
    cell.up()
    return cell


def test_another_process_receives_changing_values(running: Cell) -> None:
    values = five_values(str(running.grpc))
    assert len(set(values)) > 1
    until(lambda: running.status()["state"] == "running", "state running")
    status = json.loads(running.supervisor("status", "--json").stdout)
    assert status.keys() == running.status().keys()
    name = running.instance
    assert (status["instance"], status["mode"], status["segment"]) == (name, "live", f"shmio-{name}")
    processes = {p["name"]: p for p in status["processes"]}
    assert {name: (p["kind"], p["state"], p["restarts"]) for name, p in processes.items()} == {
        "plc": ("emulator", "running", 0),
        "cell": ("source", "running", 0),
        "grpc": ("grpc", "running", 0),
    }
    assert processes["cell"]["quality"] == "good"
    assert {"cycle", "rate_hz", "overruns", "pid", "uptime_s"} <= set(processes["cell"])


def test_the_shmio_command_reads_the_cell(running: Cell) -> None:
    until(lambda: running.processes()["cell"]["quality"] == "good", "good quality")
    listed = json.loads(running.output("shmio", "list", "--json"))
    assert len(listed) == 22
    got = json.loads(running.output("shmio", "get", "--json", AXIS, "cell/Inputs/3"))
    assert set(got) == {AXIS, "cell/Inputs/3"}
    assert set(got[AXIS]) == {"value", "quality", "reason", "provenance", "source_time", "age_s"}
    assert (got[AXIS]["quality"], got[AXIS]["provenance"]) == ("good", "live")
    watched = running.run("shmio", "watch", "--json", "-n", "3", AXIS)
    assert [json.loads(line)["path"] for line in watched.stdout.splitlines()] == [AXIS] * 3
    wrong = running.run("shmio", "get", "cell/Robot_800/Axs7_Pos")
    assert (wrong.returncode, wrong.stdout) == (1, "")
    assert "did you mean 'cell/Robot_800/Axs6_Pos'" in wrong.stderr
    assert wrong.stderr.count("\n") == 1
