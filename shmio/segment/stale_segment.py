"""Claim or clear a stale segment, which is a segment whose supervisor is dead.

Processes that the supervisor has started may still run.
"""

from __future__ import annotations

import os
import pwd
import select
import signal
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from shmio.errors import AlreadyRunningError, FormatError, NotRunningError, SegmentError, UnfinishedError
from shmio.segment import shm
from shmio.segment.header import HEADER_SIZE, State
from shmio.segment.processes import SUPERVISOR_LOCK, ProcessSlot
from shmio.segment.segment import PREFIX, Segment, refuse_second
from shmio.segment.shm import SharedObject
from shmio.version import __version__

GRACE_S = 3.0


class Worker(NamedTuple):
    """A living process of the instance. The caller that gets this object must close ``pidfd``."""

    name: str
    pid: int
    pidfd: int


def claim(instance: str) -> SharedObject | None:
    """Lock the stale segment of an instance as its supervisor. Only one caller can get this lock.

    Returns:
        The segment's object; None if there is no segment.

    Raises:
        AlreadyRunningError: A supervisor is alive.
        SegmentError: This user may not open the segment.
    """
    try:
        shared = SharedObject.open(PREFIX + instance, writable=True)
    except FileNotFoundError:
        return None
    try:
        if not shared.try_lock(SUPERVISOR_LOCK):
            refuse_second(instance)
            raise AlreadyRunningError(
                f"another supervisor is starting instance {instance!r}, or another version of shmio runs it; "
                "stop it with that version"
            )
        if shared.current():
            return shared
    except BaseException:
        shared.close()
        raise
    shared.close()
    return None


def read(shared: SharedObject, instance: str) -> Segment:
    """Open a claimed segment.

    Raises:
        UnfinishedError: The segment is incomplete, because its creator died.
        FormatError: Another version of shmio made the segment.
    """
    if shared.size < HEADER_SIZE:
        raise UnfinishedError(f"{shared.name} is not a complete shmio segment")
    segment = Segment(shared, instance)
    if segment.header.version != __version__:
        raise FormatError(f"{shared.name} was made by shmio {segment.header.version}, but this is shmio {__version__}")
    return segment


def living(instance: str) -> bool:
    """Return whether any process of the instance runs, even one of another version of shmio.

    Raises:
        SegmentError: This user may not open the segment.
    """
    try:
        with Segment.open(instance) as segment:
            return any(slot.alive() for slot in segment.processes)
    except NotRunningError:
        return False
    except FormatError:
        with closing(SharedObject.open(PREFIX + instance)) as shared, _opened(_workers(shared)) as found:
            return bool(found)


def clear(instance: str, forget_control: Callable[[str], object] = lambda _: None) -> list[str]:
    """Stop the processes that a dead supervisor has left, and remove its segment, if there is one.

    Args:
        instance: Name of the instance.
        forget_control: Called with the path of the dead supervisor's control socket. During the
            call, no new supervisor can create a socket there.

    Returns:
        A line of text for each action.

    Raises:
        AlreadyRunningError: A supervisor is alive.
        SegmentError: A process cannot be identified, or does not end; then the segment is kept.
    """
    shared = claim(instance)
    if shared is None:
        return []
    try:
        return clear_claimed(shared, instance, forget_control)
    finally:
        shared.close()


def clear_claimed(
    shared: SharedObject, instance: str, forget_control: Callable[[str], object] = lambda _: None
) -> list[str]:
    """Do the work of :func:`clear` for a segment that the caller has claimed."""
    try:
        segment = read(shared, instance)
        segment.set_state(os.getpid(), State.STOPPING)  # status then shows this process, and not the dead one
        forget_control(segment.header.control)
        done = _stop_orphans(segment, shared)
    except UnfinishedError:
        done = []
    except FormatError:
        done = [f"segment {shared.name} is of another version of shmio", *_stop_mapping(shared, instance)]
    shm.unlink(shared.name)
    return [*done, f"removed the left-over segment {shared.name}"]


def _stop_orphans(segment: Segment, shared: SharedObject) -> list[str]:
    """End every process that has locked a slot.

    Lock all slots, so that no process can start later.
    """
    alive = {slot.index: slot for slot in segment.processes if not shared.try_lock(slot.index + 1)}
    found: list[Worker] = []
    deadline = time.monotonic() + GRACE_S
    try:
        while alive and time.monotonic() < deadline:
            for index, slot in list(alive.items()):
                worker = holder(slot, shared)  # None if a process has locked the slot, but not yet written its pid
                if worker is not None:
                    found.append(worker)
                if worker is not None or shared.try_lock(index + 1):
                    del alive[index]
            time.sleep(0.01 if alive else 0)
        end(segment.instance, found)
    finally:
        for worker in found:
            os.close(worker.pidfd)
    if alive:
        names = ", ".join(slot.name for slot in alive.values())
        raise SegmentError(
            f"instance {segment.instance!r} has processes whose pids shmio cannot find, so shmio does not end "
            f"them: {names}; end them, and try again"
        )
    return [f"stopped {worker.name}, pid {worker.pid}, which had lost its supervisor" for worker in found]


def _stop_mapping(shared: SharedObject, instance: str) -> list[str]:
    """End all workers of this user that have a writable mapping of a segment of unknown format."""
    with _opened(_workers(shared)) as found:
        end(instance, found)
        return [f"stopped {worker.name}, pid {worker.pid}, which had lost its supervisor" for worker in found]


def _workers(shared: SharedObject) -> Iterator[Worker]:
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit() or int(folder.name) == os.getpid():
            continue
        with suppress(OSError):
            if folder.stat().st_uid != os.geteuid():
                continue
            pid = int(folder.name)
            fd = os.pidfd_open(pid)
            module = _module(folder)
            if module and _maps(pid, shared.inode, "w"):
                yield Worker(module, pid, fd)
            else:
                os.close(fd)


def _module(folder: Path) -> str:
    """Return the shmio module that a process runs with ``python -m``.

    Return "" if the process runs no such module, or a module of ``shmio.cli``.
    """
    with suppress(OSError, ValueError):
        words = (folder / "cmdline").read_bytes().split(b"\0")
        module = words[words.index(b"-m") + 1].decode(errors="replace")
        if module.startswith("shmio.") and not module.startswith("shmio.cli"):
            return module
    return ""


@contextmanager
def _opened(workers: Iterable[Worker]) -> Iterator[list[Worker]]:
    found = list(workers)
    try:
        yield found
    finally:
        for worker in found:
            os.close(worker.pidfd)


def holder(slot: ProcessSlot, shared: SharedObject) -> Worker | None:
    """Return the process that has locked a slot; None if it is unknown or has ended.

    A process that has the worker's pid, but has not mapped the segment, does not count: the worker
    has ended, and its pid is in use again.
    """
    pid = slot.report.pid
    if not pid:
        return None
    try:
        fd = os.pidfd_open(pid)
    except OSError:
        # The process has ended. If a thread of another program now has its number, the error is EINVAL, or
        # ENOENT from Linux 6.14 on. It is also ENOENT while the process is being reaped.
        return None
    if _maps(pid, shared.inode) and slot.alive():
        return Worker(slot.name, pid, fd)
    os.close(fd)
    return None


def _maps(pid: int, inode: int, right: str = "") -> bool:
    """Return whether a process has mapped the shared memory ``inode``.

    If ``right`` is given, a letter such as ``w``, the mapping must have this permission.
    """
    device = Path(shm.DIRECTORY).stat().st_dev
    wanted = f"{os.major(device):02x}:{os.minor(device):02x}", str(inode)
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/maps").read_text(errors="replace").splitlines():
            # address perms offset dev inode path: proc_pid_maps(5)
            _, rights, _, found_device, found_inode, *_ = line.split(maxsplit=5)
            if (found_device, found_inode) == wanted and right in rights:
                return True
    return False


def end(instance: str, workers: Iterable[Worker]) -> None:
    """End processes by SIGTERM, and after ``GRACE_S`` by SIGKILL; wait until they have ended.

    Raises:
        SegmentError: Some processes do not end, or belong to another user. The message names them.
    """
    alive = {worker.pidfd: worker for worker in workers}
    stuck: list[str] = []
    for sign in (signal.SIGTERM, signal.SIGKILL):
        for fd in _ended(alive, 0):
            del alive[fd]
        for fd, worker in list(alive.items()):
            try:
                with suppress(ProcessLookupError):
                    signal.pidfd_send_signal(fd, sign)
            except PermissionError:
                stuck.append(f"{worker.name}: {_foreign(worker.pid)}")
                del alive[fd]
        deadline = time.monotonic() + GRACE_S
        while alive and (rest_s := deadline - time.monotonic()) > 0:
            for fd in _ended(alive, rest_s):
                del alive[fd]
    stuck += [f"{worker.name}: {survivor(worker.pid)}" for worker in alive.values()]
    if stuck:
        raise SegmentError(f"instance {instance!r} has processes that do not end: {'; '.join(stuck)}; then try again")


def _foreign(pid: int) -> str:
    """Describe a process that this user may not end, with the remedy."""
    try:
        uid = Path(f"/proc/{pid}").stat().st_uid
    except OSError:
        return f"pid {pid} belongs to another user, so only that user or root can end it: sudo kill {pid}"
    try:
        owner = pwd.getpwuid(uid).pw_name
    except KeyError:
        owner = str(uid)
    return f"pid {pid} belongs to user {owner}, so only {owner} or root can end it: sudo kill {pid}"


def survivor(pid: int) -> str:
    """Describe a process that still runs after SIGKILL, with the remedy."""
    state = ""
    with suppress(OSError, IndexError):  # "pid (name) state …", where the name may be anything: proc_pid_stat(5)
        state = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()[0]
    alive = (
        "is blocked in the kernel (state D), for example by a disk or a device that hangs"
        if state == "D"
        else "still runs"
    )
    return f"pid {pid} was killed and {alive}; remove the cause, or restart the host"


def _ended(pidfds: Collection[int], timeout_s: float) -> set[int]:
    """Wait until any of these processes ends; return the pidfds of all that have ended."""
    poll = select.poll()
    for fd in pidfds:
        poll.register(fd, select.POLLIN)
    return {fd for fd, _ in poll.poll(timeout_s * 1000)} if pidfds else set()
