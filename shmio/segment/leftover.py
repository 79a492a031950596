"""What a killed supervisor leaves: its segment, and its children, who live on. Found out and cleared away."""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from shmio.errors import AlreadyRunningError, SegmentError, UnfinishedError
from shmio.segment import shm
from shmio.segment.header import State
from shmio.segment.processes import SUPERVISOR_LOCK
from shmio.segment.segment import PREFIX, Segment, refuse_second
from shmio.segment.shm import SharedObject

GRACE_S = 3.0


def clear(instance: str, forget_control: Callable[[str], object] = lambda _: None) -> list[str]:
    """Stop the orphans of a dead supervisor and unlink its segment; what was done, a line each.

    The supervisor's lock is held meanwhile, so that of two callers one does it; ``forget_control`` is called with the
    path of the dead one's control socket while nobody can have made a new one.
    AlreadyRunningError: a supervisor is alive. FormatError: the segment is another version's, whose processes this one
    cannot find. SegmentError: a process cannot be identified. Nothing to clear is no error.
    """
    name = PREFIX + instance
    try:
        shared = SharedObject.open(name, writable=True)
    except FileNotFoundError:
        return []
    try:
        if not shared.try_lock(SUPERVISOR_LOCK):
            refuse_second(instance)
            raise AlreadyRunningError(f"another supervisor is just starting instance {instance!r}")
        if not shared.current():
            return []
        done = []
        with suppress(UnfinishedError), Segment.open(instance, writable=True) as segment:
            segment.set_state(os.getpid(), State.STOPPING)  # who asks meanwhile is told of us, not of the dead
            done = _stop_orphans(segment, shared)
            forget_control(segment.header.control)
        shm.unlink(name)
        return [*done, f"removed the left-over segment {name}"]
    finally:
        shared.close()


def _stop_orphans(segment: Segment, shared: SharedObject) -> list[str]:
    """Terminate every process that holds a role, and take all roles, so that a late one gets none."""
    stopped: dict[int, tuple[str, int]] = {}
    held = {slot.index: slot for slot in segment.processes if not shared.try_lock(slot.index + 1)}
    deadline = time.monotonic() + GRACE_S
    try:
        while held and time.monotonic() < deadline:
            for index, slot in list(held.items()):
                pid = slot.report.pid  # a process that has just taken its role has not told it yet
                fd = _open_if_it_maps(pid, shared.inode) if pid else None
                if fd is not None:
                    stopped[fd] = (slot.name, pid)
                if fd is not None or shared.try_lock(index + 1):
                    del held[index]
            time.sleep(0.01 if held else 0)
        for sign in (signal.SIGTERM, signal.SIGKILL):
            _signal_and_wait(set(stopped), sign, GRACE_S)
    finally:
        for fd in stopped:
            os.close(fd)
    if held:
        names = ", ".join(slot.name for slot in held.values())
        raise SegmentError(
            f"instance {segment.instance!r} has processes that cannot be told from others: {names}; end them first"
        )
    return [f"stopped {name}, pid {pid}, which had lost its supervisor" for name, pid in stopped.values()]


def _open_if_it_maps(pid: int, inode: int) -> int | None:
    """A pidfd, if the process maps the segment: certainty that the pid is not a stranger's by now."""
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return None
    with suppress(OSError):
        maps = Path(f"/proc/{pid}/maps").read_text().splitlines()
        # address perms offset dev inode path: proc_pid_maps(5)
        if any(line.split(maxsplit=5)[4] == str(inode) and str(shm.DIRECTORY) in line for line in maps):
            return fd
    os.close(fd)
    return None


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
