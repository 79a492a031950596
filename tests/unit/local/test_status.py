"""The status of an instance, read from the segment alone."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from shmio.layout.model import Layout, Register
from shmio.local import status as status_module
from shmio.local.status import ProcessStatus, SourceStatus, problems, read_status
from shmio.segment import (
    Activity,
    BlockSpec,
    BlockWriter,
    Phase,
    ProcessSpec,
    Quality,
    Report,
    Segment,
    State,
    Supervised,
)

LAYOUT = Layout("DB1", 1, 2, False, (Register("a", "INT", (), 0, None, 2, 1),))
HOUR_NS = 3600 * 1_000_000_000


class Cell:
    """A segment with a source and an endpoint. The test plays the processes of both."""

    def __init__(self, instance: str) -> None:
        specs = [ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]
        self.segment = Segment.create(instance, [BlockSpec("cell", LAYOUT, 20_000_000, HOUR_NS, 1 << 16)], specs)
        self.writer: BlockWriter | None = self.segment.writer("cell")
        self.workers: list[Segment] = []

    def run(self, name: str, restarts: int = 0) -> None:
        worker = Segment.open(self.segment.instance, writable=True)
        self.workers.append(worker)
        slot = worker.processes.find(name)
        assert slot.take()
        started_ns = self.segment.header.started_ns
        slot.supervised = Supervised(Phase.RUNNING, restarts, started_ns)
        slot.report = Report(os.getpid(), Activity.RUNNING, started_ns, (7, 3, 0, 1, 250, 49_900))

    def publish(self, cycle: int, quality: Quality = Quality.GOOD, reason: str = "") -> None:
        assert self.writer is not None
        self.writer.publish(b"ab", cycle=cycle, quality=quality, reason=reason)

    def supervisor_dies(self) -> None:
        self.segment.set_state(os.getpid(), State.RUNNING)
        self.writer = None  # it maps the segment, which keeps the segment's lock
        self.segment.close()


@pytest.fixture
def cell(instance: str) -> Iterator[Cell]:
    cell = Cell(instance)
    yield cell
    for worker in cell.workers:
        worker.close()
    if cell.writer is not None:
        cell.supervisor_dies()


def source_of(instance: str) -> SourceStatus:
    source = read_status(instance).processes[0]
    assert isinstance(source, SourceStatus)
    return source


def test_nothing_running(instance: str) -> None:
    status = msgspec.to_builtins(read_status(instance))
    assert (status["instance"], status["state"], status["processes"]) == (instance, "stopped", [])
    assert status["segment"] is None


def test_running_instance(cell: Cell, instance: str) -> None:
    cell.run("cell", restarts=2)
    cell.run("grpc")
    cell.segment.set_state(os.getpid(), State.RUNNING)
    cell.publish(5)
    status = read_status(instance)
    assert (status.state, status.mode, status.segment) == ("running", "live", f"shmio-{instance}")
    assert status.supervisor is not None
    assert status.supervisor.pid == os.getpid()
    source, grpc = status.processes
    assert (source.name, source.kind, source.state, source.pid) == ("cell", "source", "running", os.getpid())
    assert source.restarts == 2
    assert source.uptime_s >= 0
    assert isinstance(source, SourceStatus)
    assert (source.quality, source.reason, source.cycle) == ("good", "", 5)
    assert (source.rate_hz, source.overruns, source.real_time) == (49.9, 3, True)
    assert "rate_mhz" not in source.counters
    counters = {"streams": 7, "messages": 3, "dropped": 0, "published": 1, "refused": 250, "bytes": 49_900}
    assert grpc.counters == {**counters, "waiting_bytes": 0}
    assert type(grpc) is ProcessStatus, "only a source has a quality"


def test_uptime_of_a_supervisor_counts_from_its_take_over(
    cell: Cell, instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    hour_ns = 3600 * 10**9
    cell.segment.set_state(os.getpid(), State.RUNNING)
    with monkeypatch.context() as later:
        later.setattr("time.monotonic_ns", lambda now=time.monotonic_ns: now() + hour_ns)
        cell.segment.lead_to("/run/other.sock", Path("/plant/supervisor.toml"))
    monkeypatch.setattr("time.monotonic_ns", lambda now=time.monotonic_ns: now() + hour_ns + 10**9)
    supervisor = read_status(instance).supervisor
    assert supervisor is not None
    assert supervisor.uptime_s < 3600


def test_json_has_the_documented_keys(cell: Cell, instance: str) -> None:
    cell.run("cell")
    status = msgspec.json.decode(msgspec.json.encode(read_status(instance)))
    assert {"instance", "mode", "state", "segment", "processes"} <= set(status)
    common = {"name", "kind", "pid", "state", "restarts", "uptime_s"}
    source, grpc = status["processes"]
    assert common | {"quality", "cycle", "rate_hz", "overruns"} <= set(source)
    assert common <= set(grpc)


def test_a_bad_source_degrades_the_instance_at_once(cell: Cell, instance: str) -> None:
    cell.run("cell")
    cell.run("grpc")
    cell.segment.set_state(os.getpid(), State.RUNNING)
    cell.publish(6, Quality.BAD, "connection refused")
    source = source_of(instance)
    assert (source.quality, source.reason, source.rate_hz) == ("bad", "connection refused", 0.0)
    assert read_status(instance).state == "degraded"


def test_a_source_without_a_frame_is_bad(cell: Cell, instance: str) -> None:
    cell.run("cell")
    source = source_of(instance)
    assert (source.quality, source.reason, source.cycle) == ("bad", "no frame yet", None)


@pytest.mark.parametrize("state", [State.STARTING, State.STOPPING])
def test_state_while_starting_or_stopping(cell: Cell, instance: str, state: State) -> None:
    cell.segment.set_state(os.getpid(), state)
    assert read_status(instance).state == str(state)


@pytest.mark.parametrize("phase", [Phase.BACKOFF, Phase.FATAL, Phase.STOPPED, Phase.STARTING])
def test_a_process_that_does_not_run(cell: Cell, instance: str, phase: Phase) -> None:
    cell.run("cell")
    cell.run("grpc")
    cell.workers.pop().close()
    cell.segment.processes.find("grpc").supervised = Supervised(phase, 4, 0, "address in use")
    cell.segment.set_state(os.getpid(), State.RUNNING)
    status = read_status(instance)
    grpc = status.processes[1]
    assert (grpc.state, grpc.pid, grpc.uptime_s) == (str(phase), None, 0.0)
    assert (grpc.restarts, grpc.note) == (4, "address in use")
    assert status.state == "degraded"


def test_silent_supervisor_degrades_the_instance(cell: Cell, instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cell.run("cell")
    cell.run("grpc")
    cell.segment.set_state(os.getpid(), State.RUNNING)
    cell.publish(5)
    monkeypatch.setattr(status_module, "SILENT_S", 0.0)
    status = read_status(instance)
    assert status.state == "degraded"
    assert status.supervisor is not None
    assert f"supervisor pid {os.getpid()} has not responded for 0 s" in status.note


def test_a_predecessors_pid_is_not_shown(cell: Cell, instance: str) -> None:
    cell.run("cell")
    slot = cell.segment.processes.find("cell")
    slot.supervised = Supervised(Phase.STARTING, 1, slot.report.started_ns + 1)
    assert source_of(instance).pid is None


def test_dead_supervisor_with_living_processes_degrades_the_instance(cell: Cell, instance: str) -> None:
    cell.run("cell")
    cell.supervisor_dies()
    status = read_status(instance)
    assert (status.state, status.supervisor) == ("degraded", None)
    assert "supervisor is dead" in status.note
    assert [process.state for process in status.processes] == ["running", "stopped"]


def test_leftover_segment_is_a_stopped_instance(cell: Cell, instance: str) -> None:
    cell.supervisor_dies()
    status = read_status(instance)
    assert (status.state, status.processes, status.running) == ("stopped", [], False)
    assert "left" in status.note


def test_dead_process_is_stopped_whatever_its_last_report(cell: Cell) -> None:
    cell.run("cell")
    cell.run("grpc")
    cell.publish(1)
    cell.segment.set_state(os.getpid(), State.RUNNING)
    assert read_status(cell.segment.instance).state == "running"
    cell.workers.pop().close()
    status = read_status(cell.segment.instance)
    assert (status.state, status.processes[1].state, status.processes[1].note) == ("degraded", "stopped", "dead")


@pytest.mark.parametrize("content", [b"", b"0123456789", bytes(8192)])
def test_incomplete_segment_is_a_stopped_instance(instance: str, content: bytes) -> None:
    Path(f"/dev/shm/shmio-{instance}").write_bytes(content)
    status = read_status(instance)
    assert (status.state, status.processes) == ("stopped", [])
    assert status.note


def test_a_recorder_that_cannot_write_degrades_the_instance(cell: Cell, instance: str) -> None:
    cell.segment.processes.add(ProcessSpec("recorder", "recorder"))
    for name in ("cell", "grpc", "recorder"):
        cell.run(name)
    cell.publish(5)
    cell.segment.set_state(os.getpid(), State.RUNNING)
    slot = cell.workers[-1].processes.find("recorder")
    started_ns = cell.segment.header.started_ns
    for note, state in (("to a.mem", "running"), ("a.mem: No space left on device", "degraded")):
        slot.report = Report(os.getpid(), Activity.RUNNING, started_ns, (), note)
        assert read_status(instance).state == state
    status = read_status(instance)
    assert status.processes[2].note == "a.mem: No space left on device"
    assert problems(status) == ["recorder: a.mem: No space left on device"]
    slot.supervised = Supervised(Phase.FATAL, 0, started_ns, "it ended 5 times")
    assert problems(read_status(instance)) == ["recorder is fatal: it ended 5 times"]
