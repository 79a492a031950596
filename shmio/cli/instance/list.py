"""``shmio-supervisor list``: the instances of this host."""

from __future__ import annotations

import argparse
import sys

import msgspec

from shmio.errors import ControlError, NotRunningError, SegmentError
from shmio.local.status import status_of, supervisor_silence
from shmio.logs import printable
from shmio.segment import Segment, instances
from shmio.supervisor import control

WHERE_S = 2.0
_HEADINGS = ("NAME", "STATE", "FILE", "LISTENS ON")


class Listed(msgspec.Struct):
    """An instance in the list.

    ``file`` is the configuration that it was started from, and ``listen`` has addresses by process;
    both are empty if unknown. ``note`` is a remark for the user.
    """

    name: str
    state: str
    file: str = ""
    listen: dict[str, list[str]] = {}
    note: str = ""


def execute(arguments: argparse.Namespace) -> int:
    """Print a line for each instance."""
    found = [one for name in instances() if (one := _look(name))]
    if arguments.json:
        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    elif found:
        print("\n".join(map(printable, _table(found))))
    else:
        print("no instance is running", file=sys.stderr)
    return 0


def _look(name: str) -> Listed | None:
    """Return what this user may know of an instance, or None if it has just ended."""
    try:
        with Segment.open(name) as segment:
            status = status_of(segment, f"shmio-supervisor down --instance {name} stops them")
            listed = Listed(name, status.state, str(segment.config or ""), note=status.note)
            if segment.supervised:
                listed.listen, listed.note = _listening(segment, listed.note)
            return listed
    except NotRunningError as error:
        return Listed(name, "unknown", note=str(error)) if name in instances() else None
    except SegmentError as error:  # of another user or version
        return Listed(name, "unknown", note=str(error))


def _listening(segment: Segment, note: str) -> tuple[dict[str, list[str]], str]:
    """Return the supervisor's addresses by process, and the note, or why there are none."""
    try:
        answer = control.request(segment.header.control, control.Where(), WHERE_S, lambda: supervisor_silence(segment))
        return answer.get("listen", {}), note
    except ControlError as error:
        return {}, note or str(error)


def _table(found: list[Listed]) -> list[str]:
    rows = [_HEADINGS]
    for one in found:
        listen = ", ".join(f"{process} {' '.join(addresses)}" for process, addresses in one.listen.items())
        rows.append((one.name, one.state, one.file or "-", "; ".join(filter(None, (listen, one.note))) or "-"))
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADINGS) - 1)]
    return [
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]) for row in rows
    ]
