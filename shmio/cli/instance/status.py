"""``shmio-supervisor status``: print the state of an instance and its processes."""

from __future__ import annotations

import argparse
import sys

import msgspec

from shmio.cli.target import config_option, target
from shmio.errors import NotRunningError
from shmio.local.status import ClockStatus, InstanceStatus, ProcessStatus, SourceStatus, read_status
from shmio.logs import printable
from shmio.model.clock import ClockMode

_HEADINGS = ("NAME", "KIND", "STATE", "PID", "RESTARTS", "UPTIME", "")


def execute(arguments: argparse.Namespace) -> int:
    """Print the status; return 1 if the instance does not run."""
    try:
        wanted = target(arguments)
        status = read_status(wanted.name, config_option(arguments), wanted.file)
    except NotRunningError as error:
        status = InstanceStatus(None, note=str(error))
    if arguments.json:
        print(msgspec.json.format(msgspec.json.encode(status), indent=2).decode())
    elif status.running:
        print("\n".join(map(printable, _table(status))))
    else:
        print(status.note if status.instance is None else f"{status.instance}: stopped; {status.note}", file=sys.stderr)
    return 0 if status.running else 1


def _table(status: InstanceStatus) -> list[str]:
    supervisor = status.supervisor
    facts = [f"{status.instance}: {status.state}", f"mode {status.mode}", f"segment {status.segment}"]
    if supervisor:
        facts.append(f"supervisor pid {supervisor.pid}, up {_duration(supervisor.uptime_s)}")
    lines = [", ".join(facts)]
    if status.note:
        lines.append(status.note)
    if status.clock and status.clock.mode != "wall":
        lines.append(clock_line(status.clock))
    rows = [_HEADINGS, *(_row(process) for process in status.processes)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADINGS) - 1)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=False)]
        lines.append("  ".join([*cells, row[-1]]).rstrip())
    return lines


def clock_line(clock: ClockStatus, dt_ms: float | None = None) -> str:
    """Return the state of the clock as text.

    ``dt_ms`` is the size of the steps that were made; None if that is the clock's step size.
    """
    if clock.mode == str(ClockMode.WALL):
        return f"real time {clock.time_s:.3f} s"
    size = f"{clock.step_size_ms:g} ms"
    step = f"{clock.step}, steps of {size}" if dt_ms is None else f"{clock.step} of {dt_ms:g} ms, step size {size}"
    how = f", playing at {clock.rate:g} times real time" if clock.playing else ""
    note = f"; {clock.note}" if clock.note else ""
    return f"virtual time {clock.time_s:.3f} s, step {step}{how}{note}"


def _row(process: ProcessStatus) -> tuple[str, ...]:
    details = []
    if isinstance(process, SourceStatus):
        details.append(f"{process.quality}: {process.reason}" if process.reason else process.quality)
        if process.cycle is not None:
            rate = f"{process.rate_hz:.1f}" if process.rate_hz else "-"
            overruns = f"{process.overruns} overrun{'s' * (process.overruns != 1)}"
            details.append(f"cycle {process.cycle}, {rate} Hz, {overruns}")
    if process.note and not _said(process):
        details.append(process.note)
    if process.kind == "mqtt" and (missed := process.counters.get("missed")):
        details.append(f"{missed} frame{'s' * (missed != 1)} missed")
    pid = "-" if process.pid is None else str(process.pid)
    uptime = _duration(process.uptime_s)
    return process.name, process.kind, process.state, pid, str(process.restarts), uptime, "; ".join(details)


def _said(process: ProcessStatus) -> bool:
    """Return whether the note only repeats the source's reason, in full or shortened."""
    return isinstance(process, SourceStatus) and (
        process.reason.startswith(process.note) or bool(process.reason and process.note.startswith(process.reason))
    )


def _duration(seconds: float) -> str:
    whole = int(seconds)
    days, hours, minutes = whole // 86400, whole // 3600 % 24, whole // 60 % 60
    if days:
        return f"{days} d {hours} h"
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {whole % 60} s" if minutes else f"{whole} s"
