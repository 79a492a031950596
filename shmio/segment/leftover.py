"""What a killed supervisor leaves: its segment, and its children, who live on. Found out and cleared away."""

from __future__ import annotations

import os
import select
import signal
import time
from contextlib import suppress
from pathlib import Path

from shmio.errors import AlreadyRunningError, NotRunningError, SegmentError
from shmio.segment import shm
from shmio.segment.processes import SUPERVISOR_LOCK
from shmio.segment.segment import PREFIX, Segment
from shmio.segment.shm import SharedObject

GRACE_S = 3.0


def clear(instance: str) -> list[str]:
    """Stop the orphans of a dead supervisor and unlink its segment; what was done, a line each.

    The supervisor's lock is held meanwhile, so that of two callers one does it. AlreadyRunningError: a supervisor is
    alive. Nothing to clear is no error.
    """
    name = PREFIX + instance
    try:
        shared = SharedObject.open(name, writable=True)
    except FileNotFoundError:
        return []
    try:
        if not shared.try_lock(SUPERVISOR_LOCK):
            raise AlreadyRunningError(_supervisor(instance))
        if not shared.current():
            return []
        done = _stop_orphans(instance)
        shm.unlink(name)
        return [*done, f"removed the left-over segment {name}"]
    finally:
        shared.close()


def _supervisor(instance: str) -> str:
    try:
        with Segment.open(instance) as segment:
            return f"instance {instance!r} is already running, supervisor pid {segment.supervisor[0]}"
    except SegmentError:
        return f"another supervisor is just starting instance {instance!r}"


def _stop_orphans(instance: str) -> list[str]:
    """Terminate every process that still holds its role's lock."""
    try:
        segment = Segment.open(instance)
    except (NotRunningError, SegmentError):
        return []  # not a whole segment: its supervisor died before it had children
    with segment:
        orphans = [(slot.name, slot.report.pid) for slot in segment.processes if slot.alive()]
        handles: dict[int, tuple[str, int]] = {}
        for name, pid in orphans:
            with suppress(ProcessLookupError):
                fd = os.pidfd_open(pid) if pid else -1
                if fd >= 0 and _maps(pid, segment.shared.name):
                    handles[fd] = (name, pid)
                elif fd >= 0:
                    os.close(fd)
        try:
            for sign, grace_s in ((signal.SIGTERM, GRACE_S), (signal.SIGKILL, GRACE_S)):
                _signal_and_wait(set(handles), sign, grace_s)
        finally:
            for fd in handles:
                os.close(fd)
        return [f"stopped {name}, pid {pid}, which had lost its supervisor" for name, pid in handles.values()]


def _maps(pid: int, name: str) -> bool:
    """Whether the process maps the segment: certainty that the pid is not a stranger's by now."""
    try:
        return f"{shm.DIRECTORY}/{name}" in Path(f"/proc/{pid}/maps").read_text()
    except OSError:
        return False


def _signal_and_wait(pidfds: set[int], sign: signal.Signals, grace_s: float) -> None:
    alive = pidfds - _ended(pidfds, 0)
    for fd in alive:
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(fd, sign)
    deadline = time.monotonic() + grace_s
    while alive and (rest_s := deadline - time.monotonic()) > 0:
        alive -= _ended(alive, rest_s)


def _ended(pidfds: set[int], timeout_s: float) -> set[int]:
    """Which of these processes have ended, waited for until one does."""
    poll = select.poll()
    for fd in pidfds:
        poll.register(fd, select.POLLIN)
    return {fd for fd, _ in poll.poll(timeout_s * 1000)}
