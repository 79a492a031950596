"""``shmio-supervisor down``: stop an instance and wait for its end."""

from __future__ import annotations

import argparse
import os
import select
from contextlib import suppress

from shmio.cli.target import ask, target
from shmio.errors import FormatError, NotRunningError, UnfinishedError
from shmio.segment import Segment, instances, stale_segment
from shmio.supervisor import control
from shmio.supervisor.control import remove_socket, socket_path

STOP_S = 30.0
EXIT_S = 5.0


def execute(arguments: argparse.Namespace) -> int:
    """Ask the supervisor to stop; if it is dead, remove what it left."""
    wanted = target(arguments)
    name = wanted.name
    if name not in instances():
        raise NotRunningError(f"no instance {name!r} is running: there is nothing to stop")
    try:
        with suppress(UnfinishedError), wanted.open() as segment:
            if segment.supervised:
                _stop(segment)
                return 0
    except FormatError as error:  # the file that it was started from is unknown
        if wanted.file is not None:
            raise FormatError(f"{error}; down --instance {name} clears it if its supervisor is dead") from None
    print(f"{name}: its supervisor is dead; clearing what it left")
    for line in stale_segment.clear(name, forget_control=lambda path: _forget(path, name)):
        print(line)
    return 0


def _forget(path: str, name: str) -> None:
    if path == socket_path(name):  # never a path from another user's segment
        remove_socket(path)


def _stop(segment: Segment) -> None:
    pid = segment.supervisor[0]
    print(f"stopping {segment.instance}, supervisor pid {pid}", flush=True)
    pidfd = _pidfd(pid)
    try:
        ask(segment, control.Stop(), STOP_S)
        if pidfd is not None:
            select.select([pidfd], [], [], EXIT_S)
    finally:
        if pidfd is not None:
            os.close(pidfd)
    print(f"{segment.instance} is stopped")


def _pidfd(pid: int) -> int | None:
    """Return a descriptor that signals the supervisor's end; None in another PID namespace."""
    with suppress(OSError):
        return os.pidfd_open(pid)
    return None
