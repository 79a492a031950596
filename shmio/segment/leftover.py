"""What a killed supervisor leaves: its segment, and its living children. Found out, taken over or cleared away."""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from shmio import __version__
from shmio.errors import AlreadyRunningError, FormatError, SegmentError, UnfinishedError
from shmio.segment import shm
from shmio.segment.header import HEADER_SIZE, State
from shmio.segment.processes import SUPERVISOR_LOCK, ProcessSlot
from shmio.segment.segment import PREFIX, Segment, refuse_second
from shmio.segment.shm import SharedObject

GRACE_S = 3.0


class Worker(NamedTuple):
    """A living process of the instance; whoever has it closes ``pidfd``."""

    name: str
    pid: int
    pidfd: int


def claim(instance: str) -> SharedObject | None:
    """The instance's left-over segment, with its supervisor's lock taken; None when there is none.

    Of several callers one gets it. AlreadyRunningError: a supervisor is alive. SegmentError: no permission.
    """
    try:
        shared = SharedObject.open(PREFIX + instance, writable=True)
    except FileNotFoundError:
        return None
    try:
        if not shared.try_lock(SUPERVISOR_LOCK):
            refuse_second(instance)
            raise AlreadyRunningError(
                f"another supervisor is just starting instance {instance!r}, or it is of another version of shmio: "
                "end it with the version that started it"
            )
        if shared.current():
            return shared
    except BaseException:
        shared.close()
        raise
    shared.close()
    return None


def read(shared: SharedObject, instance: str) -> Segment:
    """A claimed segment. UnfinishedError: its maker died; FormatError: it is another version's."""
    if shared.size < HEADER_SIZE:
        raise UnfinishedError(f"{shared.name} is not a whole shmio segment")
    segment = Segment(shared, instance)
    if segment.header.version != __version__:
        raise FormatError(f"{shared.name} was made by shmio {segment.header.version}, this is {__version__}")
    return segment


def clear(instance: str, forget_control: Callable[[str], object] = lambda _: None) -> list[str]:
    """Stop the orphans of a dead supervisor and unlink its segment; what was done, a line each.

    ``forget_control`` is called with the path of the dead one's control socket while nobody can have made a new one.
    AlreadyRunningError: a supervisor is alive. SegmentError: a process cannot be identified. Nothing to clear is no
    error.
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
    """As :func:`clear`, of a segment that the caller has claimed."""
    try:
        segment = read(shared, instance)
        segment.set_state(os.getpid(), State.STOPPING)  # who asks meanwhile is told of us, not of the dead
        forget_control(segment.header.control)
        done = _stop_orphans(segment, shared)
    except UnfinishedError:
        done = []
    except FormatError:
        done = [f"segment {shared.name} is of another version of shmio", *_stop_mapping(shared)]
    shm.unlink(shared.name)
    return [*done, f"removed the left-over segment {shared.name}"]


def _stop_orphans(segment: Segment, shared: SharedObject) -> list[str]:
    """End every process that holds a role, and take all roles, so that a late one gets none."""
    held = {slot.index: slot for slot in segment.processes if not shared.try_lock(slot.index + 1)}
    found: list[Worker] = []
    deadline = time.monotonic() + GRACE_S
    try:
        while held and time.monotonic() < deadline:
            for index, slot in list(held.items()):
                worker = holder(slot, shared)  # one that has just taken its role has not told its pid yet
                if worker is not None:
                    found.append(worker)
                if worker is not None or shared.try_lock(index + 1):
                    del held[index]
            time.sleep(0.01 if held else 0)
        end(found)
    finally:
        for worker in found:
            os.close(worker.pidfd)
    if held:
        names = ", ".join(slot.name for slot in held.values())
        raise SegmentError(
            f"instance {segment.instance!r} has processes that cannot be told from others: {names}; end them first"
        )
    return [f"stopped {worker.name}, pid {worker.pid}, which had lost its supervisor" for worker in found]


def _stop_mapping(shared: SharedObject) -> list[str]:
    """End the processes of a segment whose format is not known: this user's workers that may write to it."""
    with _opened(_workers(shared)) as found:
        end(found)
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
    """The module of ours that a process runs by ``-m``; empty for others and for our commands."""
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
    """The process that holds a role, if it is known for certain: it maps the segment, so its pid is no stranger's."""
    pid = slot.report.pid
    if not pid:
        return None
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return None
    if _maps(pid, shared.inode) and slot.alive():
        return Worker(slot.name, pid, fd)
    os.close(fd)
    return None


def _maps(pid: int, inode: int, right: str = "") -> bool:
    """Whether a process maps the object, with this right."""
    device = shm.DIRECTORY.stat().st_dev
    wanted = f"{os.major(device):02x}:{os.minor(device):02x}", str(inode)
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/maps").read_text(errors="replace").splitlines():
            # address perms offset dev inode path: proc_pid_maps(5)
            _, rights, _, found_device, found_inode, *_ = line.split(maxsplit=5)
            if (found_device, found_inode) == wanted and right in rights:
                return True
    return False


def end(workers: Iterable[Worker]) -> None:
    """Have processes end, by SIGTERM, then SIGKILL; returns when they have, or after ``GRACE_S`` for each signal."""
    alive = {worker.pidfd for worker in workers}
    for sign in (signal.SIGTERM, signal.SIGKILL):
        alive -= _ended(alive, 0)
        for fd in alive:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(fd, sign)
        deadline = time.monotonic() + GRACE_S
        while alive and (rest_s := deadline - time.monotonic()) > 0:
            alive -= _ended(alive, rest_s)


def _ended(pidfds: set[int], timeout_s: float) -> set[int]:
    """Which of these processes have ended, waited for until one does."""
    poll = select.poll()
    for fd in pidfds:
        poll.register(fd, select.POLLIN)
    return {fd for fd, _ in poll.poll(timeout_s * 1000)} if pidfds else set()
