"""What ``shmio-supervisor status`` tells: read from the segment alone, so it works whoever is dead."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from shmio.errors import NotRunningError, SegmentError
from shmio.segment.clock import ClockState
from shmio.segment.frame import Quality
from shmio.segment.header import State as InstanceState
from shmio.segment.processes import Phase, ProcessSlot
from shmio.segment.segment import Segment, running_instances

SILENT_S = 5.0
"""A supervisor without a heartbeat for this long is stopped, or hangs."""


class ProcessStatus(msgspec.Struct, kw_only=True):
    """One process. ``uptime_s`` is the time since its last start, 0 when it is not alive; ``pid`` is null then."""

    name: str
    kind: str
    pid: int | None
    state: str
    restarts: int
    uptime_s: float
    note: str
    counters: dict[str, int]


class SourceStatus(ProcessStatus, kw_only=True):
    """A source: its process, and the newest frame of its block. ``cycle`` is null before the first.

    ``real_time``: steps do not move it, as it has a device.
    """

    quality: str
    reason: str
    cycle: int | None
    rate_hz: float
    overruns: int
    real_time: bool


class SupervisorStatus(msgspec.Struct):
    """The supervisor itself."""

    pid: int
    uptime_s: float


class ClockStatus(msgspec.Struct):
    """The instance's clock. ``mode``: wall or virtual. ``step``: number of the last one that all have finished.

    ``note``: whom a step waits for, why the last one failed, or what it did not move; before the first
    one how real time comes back.
    """

    mode: str
    time_s: float
    step: int
    step_size_ms: float
    playing: bool
    rate: float
    note: str


class InstanceStatus(msgspec.Struct):
    """An instance. ``supervisor`` is null when it is dead, ``segment`` and ``clock`` when there is none."""

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
        """Whether anything of it runs."""
        return self.state != str(InstanceState.STOPPED)


def read_status(instance: str, config: str | None = None, file: Path | None = None) -> InstanceStatus:
    """The status of an instance, running or not. SegmentError: a segment that may not be read.

    ``file``: the configuration that it must have been started from, if any; WrongInstanceError.
    ``config``: what a command line has to say to name its configuration, such as ``-c plc.toml``; empty if nothing,
    None if that is not known.
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
    """The status of an instance whose segment is open. ``remedy``: what to say where its supervisor is dead.

    ``asking``: kind of the process that asks, if it is one of the instance's: nobody sees a lock of his own.
    """
    supervised = segment.supervised
    pid, state = segment.supervisor
    now_ns = time.monotonic_ns()
    processes = [
        _process(segment, slot, slot.alive() or slot.kind == asking, supervised, now_ns) for slot in segment.processes
    ]
    status = InstanceStatus(
        instance=segment.instance,
        mode=segment.header.mode,
        segment=segment.shared.name,
        segment_bytes=segment.shared.size,
        clock=clock_status(segment.clock.read()),
    )
    if not supervised:
        if not any(process.pid for process in processes):
            status.note = "its supervisor died and left the segment; the next up or down clears it"
            return status
        status.note = f"its supervisor is dead, nothing watches the processes; {remedy}"
        status.state = str(InstanceState.DEGRADED)
    else:
        status.supervisor = SupervisorStatus(pid, _seconds(now_ns - segment.supervised_since_ns))
        status.note = segment.note
        status.state = str(_state(state, processes, status.note))
        if silence := supervisor_silence(segment):
            status.state, status.note = str(InstanceState.DEGRADED), silence
    status.processes = processes
    return status


def clock_status(state: ClockState) -> ClockStatus:
    """What the clock page says, in the units of a reader."""
    return ClockStatus(
        str(state.mode), state.present_ns / 1e9, state.done, state.step_size_ns / 1e6, state.playing, state.rate,
        state.note,
    )  # fmt: skip


def supervisor_silence(segment: Segment) -> str | None:
    """What to say about a living supervisor that shows no sign of life; None if it does."""
    silent_s = (time.monotonic_ns() - segment.supervisor_heartbeat_ns) / 1e9
    if silent_s < SILENT_S:
        return None
    pid = segment.supervisor[0]
    return (
        f"supervisor pid {pid} has shown no sign of life for {silent_s:.0f} s: if it was stopped, kill -CONT {pid} "
        f"lets it go on; else kill -KILL {pid}, then shmio-supervisor down --instance "
        f"{segment.instance} clears what is left"
    )


def _state(told: InstanceState, processes: list[SourceStatus | ProcessStatus], note: str) -> InstanceState:
    """The state as told while starting or stopping; else by what is read here, which is newer."""
    if told not in (InstanceState.RUNNING, InstanceState.DEGRADED):
        return told
    running = [p.state == str(Phase.RUNNING) and not complaint(p.kind, p.note) for p in processes]
    return assess(running, [Quality[p.quality.upper()] for p in processes if isinstance(p, SourceStatus)], note)


def complaint(kind: str, note: str) -> str:
    """What a running process reports as wrong though it runs: a recorder that is well names its file, ``to FILE``."""
    return note if kind in ("mqtt", "grpc") or (kind == "recorder" and not note.startswith("to ")) else ""


def assess(running: Sequence[bool], qualities: Sequence[Quality | None], note: str = "") -> InstanceState:
    """State of an instance after its start: degraded when a process is not running or a source is bad.

    ``running``: of each process, whether it runs without a :func:`complaint`. ``note``: what else is wrong.
    """
    healthy = not note and all(running) and not any(q in (None, Quality.BAD) for q in qualities)
    return InstanceState.RUNNING if healthy else InstanceState.DEGRADED


def _process(
    segment: Segment, slot: ProcessSlot, alive: bool, supervised: bool, now_ns: int
) -> SourceStatus | ProcessStatus:
    told, report = slot.supervised, slot.report
    phase, note = told.phase, told.note
    if not supervised:
        phase = Phase.RUNNING if alive else Phase.STOPPED
    elif phase is Phase.RUNNING and not alive:  # a supervisor that lives soon says so itself
        phase, note = Phase.STOPPED, "dead"
    counters = slot.counters
    current = alive and report.pid != 0 and report.started_ns >= told.spawned_ns  # not a predecessor's report
    values = ProcessStatus(
        name=slot.name,
        kind=slot.kind,
        pid=report.pid if current else None,
        state=str(phase),
        restarts=told.restarts,
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
    )


def _seconds(duration_ns: int) -> float:
    return round(max(0, duration_ns) / 1e9, 3)
