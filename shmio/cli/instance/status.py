"""``shmio-supervisor status`` and ``list``: print the state of one instance, or of all on this host."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import msgspec

from shmio import control
from shmio.cli.step import clock_line
from shmio.cli.target import config_option, target
from shmio.errors import ControlError, NotRunningError, SegmentError
from shmio.local.status import (
    InstanceStatus,
    ProcessStatus,
    SourceStatus,
    read_status,
    status_of,
    supervisor_silence,
)
from shmio.segment import Segment, instances
from shmio.wording import counted, printable

_HEADINGS = ("NAME", "KIND", "STATE", "PID", "RESTARTS", "UPTIME", "")
_LIST_HEADINGS = ("NAME", "STATE", "FILE", "LISTENS ON")
WHERE_S = 2.0
LATE_S = 1.0
"""Time in s by which a reader must be behind its source for the status to show the reader."""


def status(arguments: argparse.Namespace) -> int:
    """Print the status of an instance; return 1 if it does not run."""
    try:
        wanted = target(arguments)
        found = read_status(wanted.name, config_option(arguments), wanted.file)
    except NotRunningError as error:
        found = InstanceStatus(None, note=str(error))
    if arguments.json:
        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    elif found.running:
        print("\n".join(map(printable, _table(found))))
    else:
        print(found.note if found.instance is None else f"{found.instance}: stopped; {found.note}", file=sys.stderr)
    return 0 if found.running else 1


def _table(status: InstanceStatus) -> list[str]:
    supervisor = status.supervisor
    facts = [f"{status.instance}: {status.state}", f"mode {status.mode}", f"segment {status.segment}"]
    if supervisor:
        facts.append(f"supervisor pid {supervisor.pid}, up {duration(supervisor.uptime_s)}")
    lines = [", ".join(facts)]
    if status.note:
        lines.append(status.note)
    if status.clock and status.clock.mode != "wall":
        lines.append(clock_line(status.clock))
    return lines + columns([_HEADINGS, *(_row(process) for process in status.processes)])


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines with aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]) - 1)]
    padded = ([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]] for row in rows)
    return ["  ".join(cells).rstrip() for cells in padded]


def _row(process: ProcessStatus) -> tuple[str, ...]:
    details = []
    if isinstance(process, SourceStatus):
        details.append(f"{process.quality}: {process.reason}" if process.reason else process.quality)
        if process.cycle is not None:
            rate = f"{process.rate_hz:.1f}" if process.rate_hz else "-"
            overruns = counted(process.overruns, "overrun")
            details.append(f"cycle {process.cycle}, {rate} Hz, {overruns}")
        if process.readers and (slowest := process.readers[0]).lag_s >= LATE_S:
            details.append(f"{slowest.process} is {slowest.frames} frames ({slowest.lag_s:.1f} s) behind")
    if process.note and not _said(process):
        details.append(process.note)
    if process.kind == "mqtt" and (missed := process.counters.get("missed")):
        details.append(f"{counted(missed, 'frame')} missed")
    pid = "-" if process.pid is None else str(process.pid)
    uptime = duration(process.uptime_s)
    return process.name, process.kind, process.state, pid, str(process.restarts), uptime, "; ".join(details)


def _said(process: ProcessStatus) -> bool:
    """Return whether the note of a process only repeats the reason that its source gives.

    The note may be a shortened form of the reason.
    """
    return isinstance(process, SourceStatus) and (
        process.reason.startswith(process.note) or bool(process.reason and process.note.startswith(process.reason))
    )


def duration(seconds: float) -> str:
    """Return a time in s as text, such as ``2 h 10 min``."""
    whole = int(seconds)
    days, hours, minutes = whole // 86400, whole // 3600 % 24, whole // 60 % 60
    if days:
        return f"{days} d {hours} h"
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {whole % 60} s" if minutes else f"{whole} s"


class Listed(msgspec.Struct):
    """A row of ``list``: one instance.

    ``file`` is the configuration from which the instance was started. ``listen`` has the addresses
    on which each process listens. Either is empty if it is not known. ``note`` is a remark for the
    user.
    """

    name: str
    state: str
    file: str = ""
    listen: dict[str, list[str]] = {}
    note: str = ""


def list_instances(arguments: argparse.Namespace) -> int:
    """Print a line for each instance of this host."""
    found = [one for name in instances() if (one := _listed(name))]
    if arguments.json:
        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    elif found:
        print("\n".join(map(printable, _list_table(found))))
    else:
        print("no instance is running", file=sys.stderr)
    return 0


def _listed(name: str) -> Listed | None:
    """Return what this user can find out about an instance; None if the instance has just ended."""
    try:
        with Segment.open(name) as segment:
            status = status_of(segment, f"shmio-supervisor down --instance {name} stops them")
            listed = Listed(name, status.state, str(segment.config or ""), note=status.note)
            if segment.supervised:
                listed.listen, listed.note = _listening(segment, listed.note)
            return listed
    except NotRunningError as error:
        return Listed(name, "unknown", note=str(error)) if name in instances() else None
    except SegmentError as error:  # the segment belongs to another user or version
        return Listed(name, "unknown", note=str(error))


def _listening(segment: Segment, note: str) -> tuple[dict[str, list[str]], str]:
    """Return the addresses on which each process listens, and the note.

    If the supervisor does not tell the addresses and ``note`` is empty, the new note says why.
    """
    try:
        answer = control.request(segment.header.control, control.Where(), WHERE_S, lambda: supervisor_silence(segment))
        return answer.get("listen", {}), note
    except ControlError as error:
        return {}, note or str(error)


def _list_table(found: list[Listed]) -> list[str]:
    rows = [_LIST_HEADINGS]
    for one in found:
        listen = ", ".join(f"{process} {' '.join(addresses)}" for process, addresses in one.listen.items())
        rows.append((one.name, one.state, one.file or "-", "; ".join(filter(None, (listen, one.note))) or "-"))
    return columns(rows)
