"""Processes that not even SIGKILL ends. They are reported, and delay nothing else."""

from __future__ import annotations

import os
import signal
import time

import pytest

from shmio.control import Reload, Restart, Stop
from shmio.errors import ControlError
from shmio.segment import Segment, instances
from tests.unit.supervisor.harness import CELL, Launch, Launched, until

STUCK = "pid {pid} was killed and still runs; remove the cause, or restart the host"


def held(launch: Launch, name: str) -> tuple[Launched, int, str]:
    """Return a cell with a process that cannot be ended, its pid, and the expected report."""
    jobs = [(n, kind, ["stubborn", "good"] if n == name else behaviour) for n, kind, behaviour in CELL]
    cell = launch(jobs, grace_s=0.05, kill_s=0.05)
    cell.wait_state("running")
    (cell.folder / "held").touch()
    pid = cell.pid(name)
    return cell, pid, f"{name}: {STUCK.format(pid=pid)}"


def test_a_restart_names_a_stuck_process_and_continues_after_its_end(launch: Launch) -> None:
    cell, pid, stuck = held(launch, "cell")
    for _ in range(2):
        with pytest.raises(ControlError) as caught:
            cell.request(Restart("cell"))
        assert str(caught.value) == f"{stuck}; it starts again as soon as the old process has ended"
    told = cell.of("cell")
    assert (told.pid, told.note) == (pid, STUCK.format(pid=pid))
    assert cell.status().state == "degraded"
    assert cell.log().count(stuck) == 1
    os.kill(cell.pid("grpc"), signal.SIGKILL)
    until(lambda: cell.of("grpc").restarts == 1 and cell.of("grpc").state == "running")
    os.kill(pid, signal.SIGKILL)
    until(lambda: cell.of("cell").state == "running" and cell.of("cell").restarts == 1)
    assert cell.of("cell").note == ""


def test_status_reports_a_hanging_process_that_cannot_be_killed(launch: Launch) -> None:
    cell = launch([("cell", "source", ["good"])], hang_s=0.5, kill_s=0.05)
    cell.wait_state("running")
    (cell.folder / "held").touch()
    pid = cell.pid("cell")
    os.kill(pid, signal.SIGSTOP)
    until(lambda: cell.of("cell").note == STUCK.format(pid=pid))
    assert cell.of("cell").state == "backoff"
    os.kill(pid, signal.SIGKILL)
    until(lambda: cell.of("cell").state == "running" and cell.of("cell").restarts == 1)


def test_a_reload_names_a_stuck_process_and_continues_after_its_end(launch: Launch) -> None:
    cell, pid, stuck = held(launch, "cell")
    with pytest.raises(ControlError) as caught:
        cell.reload([*CELL[:1], *CELL[2:]])
    assert str(caught.value) == f"{stuck}; the reload continues as soon as that process has ended"
    assert cell.of("cell").note == STUCK.format(pid=pid)
    with pytest.raises(ControlError, match=f"in progress and waits for a process that does not end: {stuck}"):
        cell.request(Reload())
    os.kill(pid, signal.SIGKILL)
    until(lambda: list(cell.pids()) == ["plc", "grpc"])
    assert cell.reload([*CELL[:1], *CELL[2:]])["kept"] == ["plc", "grpc"]


def test_a_stop_names_a_stuck_process_and_stops_all_others(launch: Launch) -> None:
    cell, pid, stuck = held(launch, "cell")
    others = [os.pidfd_open(cell.pid(name)) for name in ("plc", "grpc")]
    answer = f"all other processes are stopped, but {stuck}; the stop continues as soon as that process has ended"

    def refused() -> str:
        with pytest.raises(ControlError) as caught:
            cell.request(Stop())
        return str(caught.value)

    until(lambda: refused() == answer)  # a busy host may take longer to end those that were killed
    assert refused() == answer
    for fd in others:
        with pytest.raises(ProcessLookupError):
            signal.pidfd_send_signal(fd, 0)
        os.close(fd)
    assert cell.status().state == "stopping"
    os.kill(pid, signal.SIGKILL)
    assert cell.wait_end() == 0
    assert cell.instance not in instances()


def test_a_start_fails_if_an_unready_process_cannot_be_ended(launch: Launch) -> None:
    cell = launch([("cell", "source", ["never"])], start_s=0.5, kill_s=0.05)
    (cell.folder / "held").touch()
    until((cell.folder / "cell.starts").exists)
    pid = int((cell.folder / "cell.starts").read_text())
    until(lambda: f"the start failed: cell: {STUCK.format(pid=pid)}" in cell.log())
    os.kill(pid, signal.SIGKILL)
    assert cell.wait_end() == 1
    assert cell.errors() == f"cell: {STUCK.format(pid=pid)}\n"


def test_a_take_over_fails_if_a_hanging_process_cannot_be_ended(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    cell.process.kill()
    cell.wait_end()
    (cell.folder / "held").touch()
    pid = before["cell"]
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    with Segment.open(cell.instance) as segment:
        beat_ns = segment.processes.find("cell").heartbeat_ns
        until(lambda: time.monotonic_ns() - beat_ns > 500_000_000)
    failing = launch(hang_s=0.5, grace_s=0.5)
    assert failing.wait_end() == 1
    stuck = f"cell: {STUCK.format(pid=pid)}"
    assert failing.errors() == f"instance '{cell.instance}' has processes that do not end: {stuck}; then try again\n"
    assert cell.pids() == before
    (cell.folder / "held").unlink()
    successor = launch(hang_s=0.5, grace_s=0.5)
    successor.wait_state("running")
    assert {name for name, pid in successor.pids().items() if pid == before[name]} == {"plc", "grpc"}
    assert successor.stop() == 0


def test_a_hurried_end_removes_the_segment_before_all_processes_have_ended(launch: Launch) -> None:
    cell, pid, _ = held(launch, "cell")
    cell.process.send_signal(signal.SIGTERM)
    cell.wait_state("stopping")
    cell.process.send_signal(signal.SIGINT)
    until(lambda: cell.instance not in instances())
    os.kill(pid, 0)
    cell.process.kill()  # as what ends a container does
    cell.wait_end()
    assert cell.instance not in instances()
    os.kill(pid, signal.SIGKILL)
