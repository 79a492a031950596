"""Read the status of an instance from its shared memory, without asking any process."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from shmio.errors import NotRunningError, SegmentError
from shmio.model.clock import ClockStatus, clock_status
from shmio.model.values import Quality
from shmio.segment.block import Block
from shmio.segment.header import State as InstanceState
from shmio.segment.processes import Phase, ProcessSlot
from shmio.segment.segment import Segment, running_instances

READERS: Final = frozenset({"fabric", "grpc", "mqtt", "opcua", "web", "recorder", "alerts"})
"""Kinds of the processes that can read the frames of sources."""
SILENT_S = 5.0
"""After this time in s without a heartbeat, a supervisor is reported as not responding."""


class ProcessStatus(msgspec.Struct, kw_only=True):
    """Status of one process. While the process is not alive, ``uptime_s`` is 0 and ``pid`` is null."""

    name: str
    kind: str
    pid: int | None
    state: str
    restarts: int
    uptime_s: float
    note: str
    counters: dict[str, int]


class ReaderStatus(msgspec.Struct):
    """How far a process that reads a source's frames is behind.

    ``frames`` is the number of complete frames that the process has not read. ``lag_s`` is the time
    in s since the oldest of these frames was published.
    """

    process: str
    frames: int
    lag_s: float


class SourceStatus(ProcessStatus, kw_only=True):
    """Status of a source: its process, and the newest frame of its block.

    ``cycle`` is null before the first frame. ``real_time`` is true if the source does not use the
    instance clock, so that steps do not advance it. ``readers`` are the processes of the instance
    that read the source's frames, the slowest first.
    """

    quality: str
    reason: str
    cycle: int | None
    rate_hz: float
    overruns: int
    real_time: bool
    readers: list[ReaderStatus] = []


class SupervisorStatus(msgspec.Struct):
    """Status of the supervisor."""

    pid: int
    uptime_s: float


class InstanceStatus(msgspec.Struct):
    """Status of an instance.

    ``supervisor`` is null if the supervisor is dead; ``segment`` and ``clock`` are null if there is
    no segment.
    """

    instance: str | None
    mode: str | None = None
    state: str = str(InstanceState.STOPPED)
    segment: str | None = None
    segment_bytes: int = 0
    supervisor: SupervisorStatus | None = None
    clock: ClockStatus | None = None
    processes: list[SourceStatus | ProcessStatus] = []
    note: str = ""

    @property
    def running(self) -> bool:
        """True if any process of the instance runs."""
        return self.state != str(InstanceState.STOPPED)


def read_status(instance: str, config: str | None = None, file: Path | None = None) -> InstanceStatus:
    """Read the status of an instance, running or not.

    Args:
        instance: Name of the instance.
        config: Option that names the configuration in commands, such as ``-c plc.toml``; the note
            recommends commands with this option. Empty: they need no option. None: unknown.
        file: Configuration file from which the instance must have been started; None: any.

    Raises:
        WrongInstanceError: The instance was started from another configuration.
        SegmentError: The segment cannot be read.
    """
    up = " ".join(("shmio-supervisor up", "-c FILE" if config is None else config)).rstrip()
    down = " ".join(("shmio-supervisor down", f"--instance {instance}" if config is None else config)).rstrip()
    try:
        segment = Segment.open(instance, config=file)
    except NotRunningError:
        running = ", ".join(running_instances()) or "none"
        return InstanceStatus(instance, note=f"it is not running (running: {running}); start it with {up}")
    with segment:
        return status_of(segment, f"{up} takes them over, {down} stops them")


def status_of(segment: Segment, remedy: str, asking: str = "") -> InstanceStatus:
    """Read the status of an instance from its open segment.

    Args:
        segment: The segment.
        remedy: Advice to give in the note if the supervisor is dead.
        asking: Kind of the calling process, if it belongs to the instance; else empty. The result
            reports that process as alive, because a process cannot see its own lock.
    """
    supervised = segment.supervised
    pid, state = segment.supervisor
    now_ns = time.monotonic_ns()
    alive = [slot for slot in segment.processes if slot.alive() or slot.kind == asking]
    readers = [slot for slot in alive if slot.kind in READERS]
    processes = [_process(segment, slot, slot in alive, supervised, now_ns, readers) for slot in segment.processes]
    status = InstanceStatus(
        instance=segment.instance,
        mode=segment.header.mode,
        segment=segment.shared.name,
        segment_bytes=segment.shared.size,
        clock=clock_status(segment.clock.read()),
    )
    if not supervised:
        if not any(process.pid for process in processes):
            status.note = "its supervisor died and left the segment; the next shmio-supervisor up or down clears it"
            return status
        status.note = f"its supervisor is dead, so nothing watches the processes; {remedy}"
        status.state = str(InstanceState.DEGRADED)
    else:
        status.supervisor = SupervisorStatus(pid, _seconds(now_ns - segment.supervised_since_ns))
        status.note = segment.note
        status.state = str(_state(state, processes, status.note))
        if silence := supervisor_silence(segment):
            status.state, status.note = str(InstanceState.DEGRADED), silence
    status.processes = processes
    return status


def supervisor_silence(segment: Segment) -> str | None:
    """Return a message with the remedy if the supervisor does not respond; None if it responds."""
    silent_s = (time.monotonic_ns() - segment.supervisor_heartbeat_ns) / 1e9
    if silent_s < SILENT_S:
        return None
    pid = segment.supervisor[0]
    return (
        f"supervisor pid {pid} has not responded for {silent_s:.0f} s: if it was stopped, kill -CONT {pid} "
        f"resumes it; otherwise kill -KILL {pid}, then shmio-supervisor down --instance "
        f"{segment.instance} clears what is left"
    )


def _state(state: InstanceState, processes: list[SourceStatus | ProcessStatus], note: str) -> InstanceState:
    """Return the supervisor's state while it starts or stops, else that of its processes."""
    if state not in (InstanceState.RUNNING, InstanceState.DEGRADED):
        return state
    running = [p.state == str(Phase.RUNNING) and not complaint(p.kind, p.note) for p in processes]
    return assess(running, [Quality[p.quality.upper()] for p in processes if isinstance(p, SourceStatus)], note)


def complaint(kind: str, note: str) -> str:
    """Return the note of a running process if it is about a problem, else an empty text.

    A recorder's note ``to FILE`` and the alerts' note ``active: …`` are not about a problem.
    """
    harmless = {"recorder": "to ", "alerts": "active: "}.get(kind)
    if harmless is not None:
        return "" if note.startswith(harmless) else note
    return note if kind in ("fabric", "mqtt", "grpc", "opcua", "web") else ""


def problems(status: InstanceStatus) -> list[str]:
    """Return what is wrong with the instance and its processes, apart from the quality of sources."""
    found = [status.note] if status.note else []
    for one in status.processes:
        if one.state != str(Phase.RUNNING):
            found.append(f"{one.name} is {one.state}{f': {one.note}' if one.note else ''}")
        elif why := complaint(one.kind, one.note):
            found.append(f"{one.name}: {why}")
    return found


def assess(running: Sequence[bool], qualities: Sequence[Quality | None], note: str = "") -> InstanceState:
    """Return the state of a started instance: degraded if any part has a problem, else running.

    Args:
        running: For each process, True if it runs and reports no problem (:func:`complaint`).
        qualities: Quality of each source's newest frame; None: the source has published no frame
            yet.
        note: Any other problem of the instance.
    """
    healthy = not note and all(running) and not any(q in (None, Quality.BAD) for q in qualities)
    return InstanceState.RUNNING if healthy else InstanceState.DEGRADED


def _process(
    segment: Segment, slot: ProcessSlot, alive: bool, supervised: bool, now_ns: int, readers: Sequence[ProcessSlot]
) -> SourceStatus | ProcessStatus:
    state, report = slot.supervised, slot.report
    phase, note = state.phase, state.note
    if not supervised:
        phase = Phase.RUNNING if alive else Phase.STOPPED
    elif phase is Phase.RUNNING and not alive:  # the supervisor has not noticed the death yet
        phase, note = Phase.STOPPED, "dead"
    counters = slot.counters
    current = alive and report.pid != 0 and report.started_ns >= state.spawned_ns  # else of the previous process
    values = ProcessStatus(
        name=slot.name,
        kind=slot.kind,
        pid=report.pid if current else None,
        state=str(phase),
        restarts=state.restarts,
        uptime_s=_seconds(now_ns - report.started_ns) if current else 0.0,
        note=note or (report.note if current else ""),
        counters={name: value for name, value in counters.items() if name != "rate_mhz"},
    )
    block = segment.blocks.get(slot.name)
    if slot.kind != "source" or block is None:
        return values
    quality, reason, cycle = Quality.BAD, "no frame yet", None
    try:
        frame = block.latest()
    except SegmentError as error:
        reason = str(error)
    else:
        if frame is not None:
            cycle = frame.cycle
            quality, reason = block.assess(frame)
    return SourceStatus(
        **msgspec.structs.asdict(values),
        quality=str(quality),
        reason=reason,
        cycle=cycle,
        rate_hz=counters.get("rate_mhz", 0) / 1000 if current and quality is not Quality.BAD else 0.0,
        overruns=counters.get("overruns", 0),
        real_time=not block.attributes.stepped,
        readers=_reader_statuses(block, readers),
    )


def _reader_statuses(block: Block, slots: Sequence[ProcessSlot]) -> list[ReaderStatus]:
    """Return the status of the processes that read a block, the slowest first."""
    lags = [(slot, lag) for slot in slots if (lag := block.reader_lag(slot)) is not None]
    found = [ReaderStatus(slot.name, lag.frames, round(lag.behind_ns / 1e9, 3)) for slot, lag in lags]
    return sorted(found, key=lambda reader: (-reader.lag_s, -reader.frames))


def _seconds(duration_ns: int) -> float:
    return round(max(0, duration_ns) / 1e9, 3)
