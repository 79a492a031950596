"""The supervisor with real processes that crash, hang, refuse to start or do not stop."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from shmio import control
from shmio.control import Restart, Stop, Where
from shmio.errors import ControlError
from shmio.plan.processes import Job
from shmio.segment import Segment, instances
from tests.unit.supervisor.harness import CELL, DEADLINE_S, HERE, ROOT, Launch, until


def test_processes_start_in_order_and_stop_in_reverse(launch: Launch, tmp_path: Path, runtime: Path) -> None:
    cell = launch([("grpc", "grpc", ["good"]), ("cell", "source", ["good"]), ("plc", "emulator", ["good"])])
    cell.wait_state("running")
    assert re.findall(r"(\w+) is running pid=", cell.log()) == ["plc", "cell", "grpc"]
    assert list(cell.pids()) == ["grpc", "cell", "plc"]
    assert cell.stop() == 0
    assert (tmp_path / "ends").read_text().split() == ["grpc", "cell", "plc"]
    assert cell.instance not in instances()
    assert not list((runtime / "shmio").iterdir())
    assert cell.errors() == ""


@pytest.mark.parametrize("name", ["plc", "cell", "grpc"])
def test_a_killed_process_is_restarted_and_no_other(launch: Launch, name: str) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    os.kill(cell.pid(name), signal.SIGKILL)
    cell.wait_state("degraded")
    cell.wait_state("running")
    after = cell.pids()
    assert after.pop(name) != before.pop(name)
    assert after == before
    assert [process.restarts for process in cell.status().processes] == [
        int(n == name) for n in ("plc", "cell", "grpc")
    ]
    assert f"{name} crashed: killed by SIGKILL; the supervisor is starting it again at once" in cell.log()


def test_a_process_that_crashes_at_its_start_is_retried(launch: Launch) -> None:
    cell = launch([("plc", "emulator", ["crash", "crash", "good"])], backoff_first_s=0.05)
    cell.wait_state("running")
    assert cell.of("plc").restarts == 2
    assert "plc crashed: exit status 3; the supervisor is starting it again in 0.05 s" in cell.log()


@pytest.mark.parametrize("behaviour", ["silent", "stopped"])
def test_a_process_that_hangs_is_replaced(launch: Launch, behaviour: str) -> None:
    cell = launch([("cell", "source", ["good" if behaviour == "stopped" else behaviour, "good"])], hang_s=0.5)
    cell.wait_state("running")
    if behaviour == "stopped":
        os.kill(cell.pid("cell"), signal.SIGSTOP)
    until(lambda: cell.of("cell").restarts == 1 and cell.of("cell").state == "running")
    evidence = r"no heartbeat for 0\.5 s; meanwhile its threads ran for 0\.0 s and waited 0\.[0-9] s for a processor"
    assert re.search(rf"cell hangs \({evidence}\); the supervisor is killing it", cell.log())
    assert re.search(f"cell crashed: {evidence}, killed by SIGKILL", cell.log())


def test_a_process_that_never_becomes_ready_is_replaced(launch: Launch) -> None:
    cell = launch([("cell", "source", ["never", "good"])], start_s=1.5)
    cell.wait_state("running")
    assert "cell hangs (not ready 1.5 s after its start; meanwhile its threads ran for" in cell.log()
    assert cell.of("cell").restarts >= 1, "on a busy host the next process may be late, too"


def test_a_process_that_ignores_sigterm_is_killed(launch: Launch) -> None:
    cell = launch([("plc", "emulator", ["stubborn"])], grace_s=0.2)
    cell.wait_state("running")
    assert cell.stop() == 0
    assert "plc does not stop; the supervisor is killing it" in cell.log()


def test_a_second_stop_signal_skips_the_grace_time(launch: Launch) -> None:
    cell = launch([("plc", "emulator", ["stubborn"]), ("grpc", "grpc", ["stubborn"])], grace_s=3600)
    cell.wait_state("running")
    cell.process.send_signal(signal.SIGINT)
    cell.wait_state("stopping")
    assert cell.of("grpc").note == "stopping"
    assert cell.of("plc").state == "running", "it is stopped later"
    cell.process.send_signal(signal.SIGINT)
    assert cell.wait_end() == 0
    assert cell.instance not in instances()


@pytest.mark.parametrize("signals", [(signal.SIGTERM, signal.SIGTERM), (signal.SIGTERM, signal.SIGINT)])
@pytest.mark.parametrize("state", ["starting", "running"])
def test_two_signals_at_once_leave_nothing(
    launch: Launch, tmp_path: Path, runtime: Path, state: str, signals: tuple[signal.Signals, ...]
) -> None:
    left = tmp_path / "left.sock"
    with socket.socket(socket.AF_UNIX) as listener:  # of an endpoint that was killed
        listener.bind(str(left))
    jobs = [("plc", "emulator", ["good"]), ("grpc", "grpc", ["never" if state == "starting" else "good"])]
    (tmp_path / "listen").write_text(f"unix:{left}")
    cell = launch(jobs, start_s=3600)
    if state == "running":
        cell.wait_state("running")
    else:
        until(
            lambda: (
                cell.instance in instances() and any(one.pid and one.name == "grpc" for one in cell.status().processes)
            )
        )
    pids = [pid for pid in cell.pids().values() if pid is not None]
    with Segment.open(cell.instance) as segment:
        own = Path(segment.header.control)
    (broker := own.with_suffix(".mq")).mkdir()
    for path in (own.with_stem(f"{own.stem}+plc"), broker / "s", broker / "key"):
        path.touch()
    for number in signals:
        cell.process.send_signal(number)
    assert cell.wait_end() == 0
    assert cell.instance not in instances()
    assert not left.exists()
    assert not [file for file in runtime.rglob("*") if file != own.parent]
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()]


def test_a_refused_configuration_fails_the_start(launch: Launch, tmp_path: Path) -> None:
    cell = launch([("plc", "emulator", ["good"]), ("cell", "source", ["unfit"])])
    assert cell.wait_end() == 1
    assert cell.errors() == "cell: no such thing here (exit status 2)\n"
    assert (tmp_path / "ends").read_text() == "plc\n", "the other process was stopped cleanly"
    assert cell.instance not in instances()


def test_a_process_that_never_runs_fails_the_start_and_its_traceback_is_kept(launch: Launch) -> None:
    cell = launch([("cell", "source", ["traceback"])], backoff_first_s=0.01)
    assert cell.wait_end() == 1
    assert cell.errors() == "cell: failed to start 3 times; RuntimeError: told to fail (exit status 1)\n"
    assert cell.log("cell").count("Traceback (most recent call last)") == 3


def test_a_later_refusal_is_fatal_for_that_process_only(launch: Launch) -> None:
    cell = launch([("plc", "emulator", ["good"]), ("cell", "source", ["good", "unfit", "good"])])
    cell.wait_state("running")
    plc = cell.pid("plc")
    os.kill(cell.pid("cell"), signal.SIGKILL)
    until(lambda: cell.of("cell").state == "fatal")
    assert cell.status().state == "degraded"
    assert cell.of("cell").note == "no such thing here (exit status 2)"
    assert cell.pid("plc") == plc
    assert cell.request(Restart("cell")) == {"ok": True}
    assert cell.of("cell").state == "running"


def test_restart_replaces_one_process_and_answers_when_it_runs(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    assert cell.request(Restart("cell")) == {"ok": True}
    after = cell.pids()
    assert cell.of("cell").state == "running"
    assert after.pop("cell") != before.pop("cell")
    assert after == before


def test_restart_reports_the_failure(launch: Launch) -> None:
    cell = launch([("cell", "source", ["good", "crash", "good"])])
    cell.wait_state("running")
    with pytest.raises(ControlError, match="cell did not start again: exit status 3"):
        cell.request(Restart("cell"))
    with pytest.raises(ControlError, match="unknown process 'cel'; did you mean 'cell'"):
        cell.request(Restart("cel"))


def test_a_stop_request_is_answered_when_the_instance_has_ended(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    where = cell.request(Where())
    assert where.pop("read_ns") <= time.time_ns()
    config, log_dir = str(cell.folder / "supervisor.toml"), str(cell.folder)
    assert where == {"ok": True, "config": config, "log_dir": log_dir, "listen": {}, "snapshot_dir": "snapshots"}
    assert cell.request(Stop()) == {"ok": True}
    assert cell.instance not in instances()
    assert cell.wait_end() == 0


def test_a_second_supervisor_is_refused(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    pids = cell.pids()
    second = launch()
    assert second.wait_end() == 1
    assert second.errors() == f"instance {cell.instance!r} is already running, supervisor pid {cell.process.pid}\n"
    assert cell.pids() == pids
    assert cell.request(Restart("plc")) == {"ok": True}, "the first supervisor still has its control socket"


def test_a_killed_supervisor_leaves_the_processes_and_the_next_one_takes_over(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    pids = cell.pids()
    cell.process.kill()
    cell.wait_end()
    status = cell.status()
    assert (status.state, status.supervisor) == ("degraded", None)
    assert cell.pids() == pids, "the processes continue"
    successor = launch()
    successor.wait_state("running")
    assert successor.pids() == pids
    assert f"took over cell, pid {pids['cell']}, which had lost its supervisor" in successor.log()
    assert successor.stop() == 0


def test_a_failed_supervisor_leaves_the_processes_for_the_next_one(launch: Launch) -> None:
    """Here the supervisor fails because it writes its state to a pipe without a reader."""
    cell = launch([*CELL, ("press", "source", ["good", "unfit"])])
    cell.wait_state("running")
    before = cell.pids()
    assert cell.process.stdout is not None
    cell.process.stdout.close()
    os.kill(cell.pid("press"), signal.SIGKILL)
    assert cell.wait_end() == 1
    assert cell.errors() == (
        "the supervisor failed: BrokenPipeError: [Errno 32] Broken pipe; its processes continue, and "
        "shmio-supervisor up takes them over\n"
    )
    assert "Traceback" in cell.log()
    successor = launch()
    successor.wait_state("running")
    before.pop("press")
    assert successor.pids() == before
    assert successor.stop() == 0


def test_an_unknown_process_in_a_slot_is_killed(launch: Launch) -> None:
    """An earlier supervisor may have started such a process just before its own death."""
    cell = launch([("plc", "emulator", ["good", "crash", "good"])], backoff_first_s=2)
    cell.wait_state("running")
    os.kill(cell.pid("plc"), signal.SIGKILL)
    until(lambda: cell.of("plc").state == "backoff" and cell.of("plc").restarts == 1)
    with Segment.open(cell.instance) as segment:
        job = Job(
            "plc", "emulator", cell.folder / "plc.log", {"behaviour": ["good"], "ends": str(cell.folder / "ends")}
        )
        description = job.describe(cell.instance, segment.header.epoch)
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{HERE}"}
        command = [sys.executable, "-m", "fake_worker"]
        with subprocess.Popen(command, stdin=subprocess.PIPE, env=environment) as stranger:
            assert stranger.stdin is not None
            stranger.stdin.write(description)
            stranger.stdin.close()
            try:
                assert stranger.wait(DEADLINE_S) == -signal.SIGKILL
            finally:
                stranger.kill()
        until(lambda: cell.of("plc").state == "running")
        assert cell.pid("plc") != stranger.pid
    assert f"pid {stranger.pid} occupies the slot of plc, but this supervisor did not start that process" in cell.log()


def test_a_frozen_process_is_not_taken_over(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    frozen = cell.pid("cell")
    cell.process.kill()
    cell.wait_end()
    os.kill(frozen, signal.SIGSTOP)
    until(lambda: time.monotonic_ns() - heartbeat_ns(cell.instance, "cell") > 0.5e9)
    successor = launch(hang_s=0.5)
    successor.wait_state("running")
    assert re.search(rf"replacing cell, pid {frozen}, which has given no heartbeat for \d s", successor.log())
    after = successor.pids()
    assert after.pop("cell") != before.pop("cell")
    assert after == before


def heartbeat_ns(instance: str, name: str) -> int:
    with Segment.open(instance) as segment:
        return segment.processes.find(name).heartbeat_ns


def test_a_take_over_replaces_only_processes_with_a_changed_configuration(launch: Launch) -> None:
    cell = launch([*CELL, ("press", "source", ["good"])])
    cell.wait_state("running")
    before = cell.pids()
    with Segment.open(cell.instance) as segment:
        epoch, inode = segment.header.epoch, segment.shared.inode
    cell.process.kill()
    cell.wait_end()
    successor = launch([CELL[0], ("cell", "source", ["good", "good"]), CELL[2], ("robot", "source", ["good"])])
    successor.wait_state("running")
    after = successor.pids()
    assert list(after) == ["plc", "cell", "grpc", "robot"]
    assert (after["plc"], after["grpc"]) == (before["plc"], before["grpc"])
    assert after["cell"] != before["cell"]
    assert not Path(f"/proc/{before['press']}/maps").exists() or not Path(f"/proc/{before['press']}/maps").read_text()
    with Segment.open(cell.instance) as segment:
        assert (segment.header.epoch, segment.shared.inode) == (epoch, inode)
        assert list(segment.blocks) == ["cell", "robot"]
    os.kill(successor.pid("plc"), signal.SIGKILL)
    until(lambda: successor.of("plc").restarts == 1 and successor.of("plc").state == "running")
    assert "plc crashed: ended; its exit status is unknown" in successor.log()


def test_a_closed_terminal_stops_the_instance_cleanly(launch: Launch, tmp_path: Path) -> None:
    cell = launch([("plc", "emulator", ["no end"])], grace_s=0.5)
    cell.wait_state("running")
    cell.process.send_signal(signal.SIGHUP)
    cell.wait_state("stopping")
    cell.process.send_signal(signal.SIGHUP)  # the shell sends SIGHUP, too
    assert cell.wait_end() == 0
    assert "the supervisor is killing the processes that have not stopped yet" not in cell.log()
    assert cell.instance not in instances()


def test_an_ignored_sighup_stays_ignored(launch: Launch) -> None:
    """``nohup`` starts programs with SIGHUP ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        cell = launch()
    finally:
        signal.signal(signal.SIGHUP, before)
    cell.wait_state("running")
    cell.process.send_signal(signal.SIGHUP)
    assert cell.request(Restart("plc")) == {"ok": True}


def test_a_removed_segment_stops_the_instance(launch: Launch, tmp_path: Path) -> None:
    cell = launch()
    cell.wait_state("running")
    Path(f"/dev/shm/shmio-{cell.instance}").unlink()
    assert cell.wait_end() == 1
    what = f"the shared memory shmio-{cell.instance} was removed while the instance ran"
    error = f"{what}; the supervisor is stopping all processes\n"
    assert cell.errors() == error
    assert error in cell.log()
    assert (tmp_path / "ends").read_text().split() == ["grpc", "cell", "plc"]


def test_ctrl_c_does_not_reach_the_processes(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    sessions = {os.getsid(pid) for pid in cell.pids().values() if pid is not None}
    assert len(sessions) == 3
    assert os.getsid(cell.process.pid) not in sessions


def test_a_stop_during_the_start_stops_what_has_started(launch: Launch) -> None:
    cell = launch([("plc", "emulator", ["good"]), ("cell", "source", ["never"])])
    until(lambda: cell.instance in instances() and bool(cell.status().processes))
    until(lambda: cell.of("cell").pid is not None)
    assert cell.stop() == 0
    assert cell.instance not in instances()


def test_the_segment_names_its_supervisor(launch: Launch, runtime: Path) -> None:
    cell = launch()
    cell.wait_state("running")
    with Segment.open(cell.instance) as segment:
        assert segment.supervised
        assert segment.supervisor[0] == cell.process.pid
        assert segment.header.control == str(runtime / "shmio" / f"{cell.instance}.sock")


def test_misbehaving_clients_of_the_control_socket_do_not_block_others(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    with Segment.open(cell.instance) as segment:
        path = segment.header.control

    def connected(stack: ExitStack) -> socket.socket:
        client = stack.enter_context(socket.socket(socket.AF_UNIX))
        client.connect(path)  # waits until there is room, as it has no time-out yet
        client.settimeout(DEADLINE_S)
        return client

    with ExitStack() as stack:
        for _ in range(3 * control.MAX_CLIENTS):
            connected(stack)  # never sends
        for _ in range(control.MAX_CLIENTS):
            connected(stack).sendall(b'{"do": "where"}\n')  # never reads
        endless = connected(stack)
        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            endless.sendall(b" " * (64 << 20))  # dropped, otherwise the supervisor would have to keep all bytes
        for _ in range(control.MAX_CLIENTS):
            connected(stack).sendall(b'{"do"')  # never ends
        assert cell.request(Restart("plc")) == {"ok": True}
        assert cell.status().state == "running"
        assert cell.request(Stop()) == {"ok": True}
    assert cell.wait_end() == 0
