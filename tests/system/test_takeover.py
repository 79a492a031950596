"""A cell whose supervisor is killed: the next supervisor takes over the running processes."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import grpc
import pytest

import shmio
from shmio.segment import Segment, instances
from shmio.testing.cell import BIN, PATIENCE_S, Cell, kill, until
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

PATH = "cell/Robot_800/Axs1_Pos"


def pids(cell: Cell) -> dict[str, int]:
    return {name: process["pid"] for name, process in cell.processes().items()}


def kill_supervisor(cell: Cell) -> None:
    pid = cell.status()["supervisor"]["pid"]
    kill(pid)
    until(lambda: cell.status()["supervisor"] is None, "the supervisor's death")


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def test_everything_continues_under_the_next_supervisor(cell: Cell) -> None:
    until(lambda: cell.processes()["cell"]["quality"] == "good", "good quality")
    before = pids(cell)
    with grpc.insecure_channel(str(cell.grpc)) as channel, shmio.attach(cell.instance) as reader:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        stream = stub.Subscribe(TopicDescriptor(path=PATH), timeout=4 * PATIENCE_S, wait_for_ready=True)
        next(stream)
        first = reader.frame("cell").frame
        kill_supervisor(cell)
        checked = cell.supervisor("check")
        assert (checked.returncode, "would fail" in checked.stdout) == (0, False), (
            "the ports belong to the instance's own processes"
        )
        up = cell.supervisor("up", "--detach")
        assert up.returncode == 0, up.stderr
        for name, pid in before.items():
            assert f"took over {name}, pid {pid}, which had lost its supervisor" in up.stdout
        assert pids(cell) == before
        assert reader.current
        last = reader.frame("cell").frame
        assert (last.incarnation, last.number > first.number) == (first.incarnation, True)
        assert next(stream).value
        stream.cancel()
    until(lambda: cell.status()["state"] == "running", "state running")
    # The new supervisor watches the processes that it has taken over.
    kill(before["cell"])
    until(lambda: cell.processes()["cell"]["restarts"] == 1, "a restart")
    until(lambda: cell.processes()["cell"]["state"] == "running", "the source is back")
    assert cell.supervisor("restart", "grpc").returncode == 0
    assert cell.supervisor("down").returncode == 0
    assert all(gone(pid) for pid in before.values())
    assert cell.instance not in instances()


def test_only_changed_or_frozen_processes_are_replaced(cell: Cell) -> None:
    before = pids(cell)
    kill_supervisor(cell)
    kill(before["grpc"], signal.SIGSTOP)  # shows no heartbeat when the supervisor looks, or soon after
    file = cell.folder / "supervisor.toml"
    file.write_text(file.read_text().replace("timeout = 1000", "timeout = 900"))
    up = cell.supervisor("up", "--detach")
    assert up.returncode == 0, up.stderr
    assert f"cell, pid {before['cell']}, was replaced at once: its configuration has changed\n" in up.stdout
    assert f"plc, pid {before['plc']}, was" not in up.stdout
    until(lambda: pids(cell)["grpc"] not in (None, before["grpc"]), "the frozen process is replaced")
    after = pids(cell)
    assert after["cell"] != before["cell"]
    assert after["plc"] == before["plc"]


def test_take_over_reports_the_current_state(cell: Cell) -> None:
    """Before the take-over, a reload has made the segment larger and removed the endpoint from the configuration."""
    file = cell.folder / "supervisor.toml"
    first = cell.status()["segment_bytes"]
    file.write_text(file.read_text().replace("period_ms = 20", "period_ms = 25"))
    assert cell.supervisor("reload").returncode == 0
    grown = cell.status()["segment_bytes"]
    assert grown == Path(f"/dev/shm/shmio-{cell.instance}").stat().st_size
    assert grown > first + 2**20, "the new block's ring is included"
    grpc_pid = pids(cell)["grpc"]
    kill_supervisor(cell)
    text = file.read_text()
    file.write_text(text[: text.index("[grpc]")])
    up = cell.supervisor("up", "--detach")
    assert up.returncode == 0, up.stderr
    assert f"segment shmio-{cell.instance} ({grown / 1e6:.1f} MB), logs in " in up.stdout
    assert f"grpc, pid {grpc_pid}, was stopped at once: it is no longer in the configuration\n" in up.stdout
    assert list(pids(cell)) == ["plc", "cell"]


def test_an_instance_of_another_version_is_started_anew(cell: Cell) -> None:
    before = pids(cell)
    kill_supervisor(cell)
    with Segment.open(cell.instance, writable=True) as segment:
        inode = segment.shared.inode
        segment.memory[8:12] = (7).to_bytes(4, "little")
    up = cell.supervisor("up", "--detach")
    assert up.returncode == 0, up.stderr
    assert f"segment shmio-{cell.instance} is of another version of shmio" in up.stdout
    assert all(gone(pid) for pid in before.values())
    with Segment.open(cell.instance) as segment:
        assert segment.shared.inode != inode


def test_down_clears_an_instance_of_another_version(cell: Cell) -> None:
    before = pids(cell)
    kill_supervisor(cell)
    with Segment.open(cell.instance, writable=True) as segment:
        segment.memory[8:12] = (7).to_bytes(4, "little")
    refused = cell.supervisor("down")
    assert refused.returncode == 1
    name = f"--instance {cell.instance}"
    assert f"down {name}` clears" in refused.stderr, "the file that it was started from is unknown"
    down = cell.supervisor("down", *name.split())
    assert down.returncode == 0, down.stderr
    assert all(gone(pid) for pid in before.values())
    assert cell.instance not in instances()


def test_a_segment_without_a_process_is_stale(cell: Cell) -> None:
    before = pids(cell)
    kill_supervisor(cell)
    for pid in before.values():
        kill(pid)
    until(lambda: all(gone(pid) for pid in before.values()), "the processes' death")
    up = cell.supervisor("up", "--detach")
    assert up.returncode == 0, up.stderr
    assert f"removed the left-over segment shmio-{cell.instance}" in up.stdout


def test_of_two_simultaneous_take_overs_one_succeeds(cell: Cell) -> None:
    before = pids(cell)
    kill_supervisor(cell)
    command = [str(BIN / "shmio-supervisor"), "up", "--detach"]
    racing = [
        subprocess.Popen(command, cwd=cell.folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    outcomes = [(process.communicate(timeout=PATIENCE_S)[1], process.returncode) for process in racing]
    assert sorted(status for _, status in outcomes) == [0, 1], outcomes
    assert pids(cell) == before


def test_commands_find_a_supervisor_whose_socket_has_moved(
    cell: Cell, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill_supervisor(cell)
    with Segment.open(cell.instance) as segment:
        old = segment.header.control
    assert os.path.lexists(old)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    assert cell.supervisor("up", "--detach").returncode == 0
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert not os.path.lexists(old)
    assert cell.supervisor("restart", "cell").returncode == 0
