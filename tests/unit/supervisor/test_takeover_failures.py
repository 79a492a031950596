"""A take-over that fails changes nothing. The processes continue, and a later attempt can take them over."""

from __future__ import annotations

from pathlib import Path

from tests.unit.supervisor.harness import CELL, Job, Launch


def test_a_take_over_without_a_control_socket_changes_nothing(launch: Launch, runtime: Path) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    cell.process.kill()
    cell.wait_end()
    socket = runtime / "shmio" / f"{cell.instance}.sock"
    socket.unlink()
    socket.touch()
    failing = launch()
    assert failing.wait_end() == 1
    assert failing.errors() == f"cannot create the control socket {socket}: Address already in use\n"
    assert cell.pids() == before
    socket.unlink()
    successor = launch()
    successor.wait_state("running")
    assert successor.pids() == before
    assert successor.stop() == 0


def test_a_take_over_without_room_for_new_processes_changes_nothing(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    cell.process.kill()
    cell.wait_end()
    many: list[Job] = [(f"more{i}", "emulator", ["good"]) for i in range(17)]
    failing = launch([*CELL, *many])
    assert failing.wait_end() == 1
    assert "has room for 16 more processes, not for 17" in failing.errors()
    assert Path(f"/dev/shm/shmio-{cell.instance}").exists()
    assert cell.pids() == before
    successor = launch()
    successor.wait_state("running")
    assert successor.pids() == before
    assert successor.stop() == 0
