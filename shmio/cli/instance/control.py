"""``shmio-supervisor down``, ``reload`` and ``restart``: send requests to the running supervisor."""

from __future__ import annotations

import argparse
import os
import select
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from shmio import control
from shmio.cli.common import dumps
from shmio.cli.target import target
from shmio.control import remove_socket, socket_path
from shmio.errors import FormatError, NotRunningError, UnfinishedError
from shmio.local.supervisor import ask_supervisor
from shmio.segment import Segment, instances, stale_segment
from shmio.wording import printable

STOP_S = 30.0
EXIT_S = 5.0
RELOAD_S = 90.0
RESTART_S = 40.0
WHERE_S = 5.0
PREVIEWED: Final[Mapping[str, str]] = {
    "stop": "would stop",
    "start": "would start",
    "restart": "would restart",
    "change": "would keep the connection of",
    "injections": "would change",
    "reread": "would reload the tokens and roles of",
    "keep": "would keep",
}
"""The words with which ``reload --dry-run`` prints each kind of change."""


def down(arguments: argparse.Namespace) -> int:
    """Ask the supervisor to stop the instance, and wait until the supervisor has ended.

    If the supervisor is dead, clear what it left behind.
    """
    wanted = target(arguments)
    name = wanted.name
    if name not in instances():
        raise NotRunningError(f"no instance {name!r} is running: nothing to stop")
    try:
        with suppress(UnfinishedError), wanted.open() as segment:
            if segment.supervised:
                print(f"stopping {segment.instance}, supervisor pid {segment.supervisor[0]}", flush=True)
                stop(segment)
                print(f"{segment.instance} is stopped")
                return 0
    except FormatError as error:  # the segment is unreadable, so its configuration file is unknown
        if wanted.file is not None:
            raise FormatError(
                f"{error}; if its supervisor is dead, `shmio-supervisor down --instance {name}` clears the instance"
            ) from None
    print(f"{name}: its supervisor is dead; clearing what it left")
    for line in clear(name):
        print(line)
    return 0


def clear(instance: str) -> list[str]:
    """Stop the processes that a dead supervisor has left, and return a line for each action.

    Raises:
        SegmentError: A supervisor is alive, or a process does not end.

    """
    return stale_segment.clear(instance, forget_control=lambda path: _forget(path, instance))


def _forget(path: str, name: str) -> None:
    if path == socket_path(name):  # never use a path from another user's segment
        remove_socket(path)


def stop(segment: Segment) -> None:
    """Ask the supervisor to stop the instance, and wait until the supervisor has ended.

    Raises:
        ControlError: The supervisor does not answer.

    """
    pidfd = _pidfd(segment.supervisor[0])
    try:
        ask_supervisor(segment, control.Stop(), STOP_S)
        if pidfd is not None:
            select.select([pidfd], [], [], EXIT_S)
    finally:
        if pidfd is not None:
            os.close(pidfd)


def _pidfd(pid: int) -> int | None:
    """Return a pidfd of the supervisor; None if it is in another PID namespace."""
    with suppress(OSError):
        return os.pidfd_open(pid)
    return None


def reload(arguments: argparse.Namespace) -> int:
    """Apply the changes of the configuration file; return 1 if a changed process does not run.

    With ``--dry-run``, only print what would change; return 1 if the changes would be refused.
    """
    if arguments.dry_run:
        return _preview(arguments)
    with target(arguments).open_supervised() as segment:
        answer = ask_supervisor(segment, control.Reload(), RELOAD_S)
    status = 1 if answer["problems"] else 0
    if arguments.json:
        answered = {key: answer[key] for key in ("done", "kept", "warnings", "problems")}
        print(dumps({"instance": segment.instance, **answered}, indent=2))
        return status
    for line in answer["warnings"]:
        print(printable(line), file=sys.stderr)
    for line in answer["done"]:
        print(printable(line))
    kept = len(answer["kept"])
    print(f"{segment.instance}: {kept} process{'es' * (kept != 1)} kept as {'they were' if kept != 1 else 'it was'}")
    for line in answer["problems"]:
        print(printable(line), file=sys.stderr)
    return status


def _preview(arguments: argparse.Namespace) -> int:
    with target(arguments).open_supervised() as segment:
        answer = ask_supervisor(segment, control.Reload(dry_run=True), RELOAD_S)
    faults, warnings = answer["faults"], answer["warnings"]
    kinds = [kind for kind in PREVIEWED if kind in answer]
    if arguments.json:
        answered = {kind: answer[kind] for kind in kinds}
        print(dumps({"instance": segment.instance, "faults": faults, "warnings": warnings, **answered}, indent=2))
        return 1 if faults else 0
    for line in [*faults, *warnings]:
        print(printable(line), file=sys.stderr)
    if faults:
        return 1
    for kind in kinds[:-1]:
        for line in answer[kind]:
            print(printable(f"{PREVIEWED[kind]} {line}"))
    kept = len(answer["keep"])
    print(f"{segment.instance}: {kept} process{'es' * (kept != 1)} would be kept; nothing was changed")
    return 0


def restart(arguments: argparse.Namespace) -> int:
    """Stop and start one process; return once it runs again."""
    with target(arguments).open_supervised() as segment:
        ask_supervisor(segment, control.Restart(arguments.name), RESTART_S)
        print(f"{arguments.name} runs again")
        where = ask_supervisor(segment, control.Where(), WHERE_S)
    file = Path(where["config"])
    if _changed(file, where["read_ns"]):
        print(f"{file} has changed since it was read; restart keeps the old configuration, reload takes the new")
    return 0


def _changed(file: Path, read_ns: int) -> bool:
    with suppress(OSError):
        return file.stat().st_mtime_ns > read_ns
    return False
