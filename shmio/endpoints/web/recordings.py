"""The recordings in the recorder's directory. All pages share the open files, and the threads that read them.

A page names a file, never a path. Files are read in a few threads, a part at a time, and only when
a page asks for the next part, so that a large or hostile file delays no other page.
"""

from __future__ import annotations

import asyncio
import os
import re
import stat
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from anyio import CapacityLimiter, to_thread

from shmio.errors import RecordingError
from shmio.recording.dump import Dump
from shmio.recording.format.encoding import SUPERVISED
from shmio.recording.reading.part import Part
from shmio.recording.times import lost

THREADS: Final = 2
"""Maximum number of threads that read recordings at the same time."""
MAX_LISTED: Final = 500
"""Maximum number of files that are listed: the newest ones."""
MAX_NAME: Final = 255
LOOKS: Final = 16
"""Maximum number of files whose details are read for one request for the list."""
MAX_OF_RUN: Final = 256
"""Maximum number of files that are searched for those of the present run."""
MAX_OPEN: Final = 64
"""Maximum number of files that are open at the same time."""
MAX_DAMAGE: Final = 20
"""Maximum number of damaged places that are listed for an open recording."""
OPENING_S: Final = 60.0
"""Maximum time in s that opening a file may take."""
PART_S: Final = 30.0
"""Maximum time in s that one part of the work on a file may take."""
IDLE_S: Final = 15.0
"""Time in s for which a file stays open after its last use. A deleted file takes up disk space until it is closed."""
FRESH_S: Final = 2.0
"""Minimum time in s before a growing file is opened again. If opening takes long, it is longer."""
SUFFIX: Final = ".mem"

_NAME: Final = re.compile(rf"[^/\0.][^/\0]*{re.escape(SUFFIX)}")

T = TypeVar("T")


class _StoppedError(Exception):
    """The work was stopped. This is not a ShmioError, which readers would take for damage."""


class _Watch:
    """Ends work that takes too long or was stopped, with an exception. Readers call it at intervals."""

    def __init__(self) -> None:
        self.until_s = time.monotonic() + OPENING_S
        self.work: Work[Any] | None = None

    def __call__(self) -> None:
        if self.work is not None and self.work.stopped:
            raise _StoppedError
        if time.monotonic() > self.until_s:
            raise RecordingError(
                "this takes too long; examine the file with shmio-dump verify, and repair it with shmio-dump recover"
            )


@dataclass(frozen=True, slots=True)
class _State:
    """Identity and size of a file, and when it was changed."""

    inode: int
    size: int
    changed_ns: int


@dataclass(eq=False)
class Opened:
    """An open recording. Use it only while you hold its lock."""

    name: str
    state: _State
    dump: Dump
    watch: _Watch
    took_s: float
    damage: list[str]
    """Messages about the places that could not be read."""
    opened_s: float = field(default_factory=time.monotonic)
    users: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def fresh(self) -> bool:
        """True if the file was opened so recently that opening it again is not worthwhile."""
        return time.monotonic() - self.opened_s < max(FRESH_S, 20 * self.took_s)

    def close(self) -> None:
        """Close the file, as soon as nobody uses it."""
        with self.lock:
            self.dump.close()


class Work(Generic[T]):
    """Work on a recording, part by part. Use it in the event loop's thread only."""

    def __init__(
        self, recordings: Recordings, work: Callable[[Callable[[], None]], Iterator[T]], opened: Opened | None = None
    ) -> None:
        """Prepare the work. :meth:`next` does its parts.

        Args:
            recordings: The recordings.
            work: Returns an iterator that does the work and yields its results. It runs in other
                threads. Its argument is the ``beat`` for readers that it opens.
            opened: The recording that the work uses; it is released when the work is stopped. None
                if the work opens its own files.

        """
        self._recordings, self._opened = recordings, opened
        self._watch = _Watch() if opened is None else opened.watch
        self._lock = threading.Lock() if opened is None else opened.lock
        self._parts = work(self._watch)
        self._calls = asyncio.Lock()
        self.stopped = False

    async def next(self) -> T | None:
        """Do the next part of the work, and return its result; None if there are no more parts.

        Raises:
            RecordingError: The file cannot be read.

        """
        async with self._calls:
            try:
                return None if self.stopped else await self._recordings.in_thread(self._next)
            except _StoppedError:
                return None

    def stop(self) -> None:
        """Stop the work. A part that is being done ends soon."""
        if not self.stopped:
            self.stopped = True
            if self._opened is not None:
                self._recordings.release(self._opened)

    def _next(self) -> T | None:
        with self._lock:
            self._watch.work, self._watch.until_s = self, time.monotonic() + PART_S
            try:
                return next(self._parts, None)
            except OSError as error:
                raise RecordingError(f"{error.filename}: {error.strerror}") from None
            finally:
                self._watch.work = None


class Recordings:
    """Lists and opens recordings. Use it in the event loop's thread only."""

    def __init__(self, folder: str | None) -> None:
        """Prepare to list and open recordings.

        Args:
            folder: The recorder's directory; None if the instance has no recorder.

        """
        self.folder = None if folder is None else Path(folder)
        self._limiter: CapacityLimiter | None = None
        self._opened: dict[str, Opened] = {}
        self._opening: dict[str, asyncio.Lock] = {}
        self._details: dict[str, tuple[_State, float, Mapping[str, Any]]] = {}
        self._examining: asyncio.Task[None] | None = None

    async def in_thread(self, function: Callable[[], T]) -> T:
        """Run a function in one of the threads that read recordings."""
        if self._limiter is None:
            self._limiter = CapacityLimiter(THREADS)
        return await to_thread.run_sync(function, limiter=self._limiter)

    def path(self, name: str) -> Path:
        """Return the path of the file with this name.

        Raises:
            RecordingError: The name is not that of a recording, or the instance has no recorder.

        """
        if self.folder is None:
            raise RecordingError("this instance has no recorder; add [recorder] to its configuration")
        if len(name) > MAX_NAME or not _NAME.fullmatch(name):
            raise RecordingError(f"{name[:80]!r} is not the name of a recording; a name is, for example, a50.mem")
        return self.folder / name

    async def open(self, name: str, since_s: float | None = None) -> Opened:
        """Open a recording; if it is open already, return it. Call :meth:`release` after use.

        Args:
            name: Name of the file.
            since_s: A file that has grown since it was opened is opened again, unless it was opened
                after this monotonic time, in s; if None, unless it was opened a short time ago.

        Raises:
            RecordingError: The recording cannot be opened.

        """
        path = self.path(name)
        lock = self._opening.setdefault(name, asyncio.Lock())
        try:
            async with lock:
                state = await self.in_thread(lambda: _state(path))
                known = self._opened.get(name)
                if known is not None and _serves(known, state, since_s):
                    known.users += 1
                    return known
                if len(self._opened) >= MAX_OPEN:
                    raise RecordingError(f"{MAX_OPEN} recordings are open; try again in a minute")
                opened = await self.in_thread(lambda: _open(path, state))
                opened.users = 1
                self._opened[name] = opened
                if known is not None and not known.users:
                    await self.in_thread(known.close)
                return opened
        finally:
            if not lock.locked():
                self._opening.pop(name, None)

    async def of_run(self, instance: str, epoch: str, since_s: float) -> AsyncIterator[Opened]:
        """Open and yield the recordings of an instance's present run, the newest first.

        Call :meth:`release` for each after use.

        Args:
            instance: Name of the instance.
            epoch: The instance's epoch in hexadecimal digits.
            since_s: As for :meth:`open`.

        """
        if self.folder is None:
            return
        folder = self.folder
        names = sorted((name for name, _, _ in await self.in_thread(lambda: _listed(folder))), key=_order, reverse=True)
        for name in [name for name in names if name.startswith(f"{instance}-")][:MAX_OF_RUN]:
            try:
                opened = await self.open(name, since_s)
            except RecordingError:
                continue  # the recorder has just created it, or it is not a recording
            about = opened.dump.about
            if about.get("instance") == instance and about.get("epoch") == epoch:
                if about.get("recorder") == SUPERVISED and "made_by" not in about:
                    yield opened
                    continue
            elif about.get("recorder") == SUPERVISED and about.get("instance") == instance:
                self.release(opened)
                return  # this recording, and so each older one, is of an earlier run
            self.release(opened)

    def release(self, opened: Opened, *, at_once: bool = False) -> None:
        """Release a recording after use. When nobody uses it any more, it is closed after ``IDLE_S``.

        With ``at_once``, it is closed without delay.
        """
        opened.users -= 1
        loop = asyncio.get_running_loop()
        if at_once:
            self._close_idle(opened)
        else:
            loop.call_later(IDLE_S, self._close_idle, opened)

    def _close_idle(self, opened: Opened) -> None:
        if opened.users:
            return
        if self._opened.get(opened.name) is opened:
            del self._opened[opened.name]
        asyncio.get_running_loop().run_in_executor(None, opened.close)

    # ---- list --------------------------------------------------------------------------------------------------------

    async def listed(self) -> list[dict[str, Any]]:
        """Return the recordings, the newest first. Details that are not known yet follow with a later call."""
        if self.folder is None:
            return []
        folder = self.folder
        found = await self.in_thread(lambda: _listed(folder))
        self._details = {name: self._details[name] for name, _, _ in found if name in self._details}
        rows = []
        unknown = []
        for name, state, written in found:
            known = self._details.get(name)
            if known is None or (known[0] != state and time.monotonic() > known[1]):
                unknown.append((name, state))
            details: Mapping[str, Any] = {} if known is None or known[0].inode != state.inode else known[2]
            rows.append({"name": name, "size": state.size, "writing": written, "known": bool(details), **details})
        if unknown and (self._examining is None or self._examining.done()):
            self._examining = asyncio.get_running_loop().create_task(self._examine(unknown))
        return rows

    async def _examine(self, files: list[tuple[str, _State]]) -> None:
        """Find the details of some files, one after the other. The next request for the list continues."""
        for name, state in files[:LOOKS]:
            opened: Opened | None = None
            started_s = time.monotonic()
            try:
                opened = await self.open(name)
                details = _details(opened)
            except RecordingError as error:
                details = {"problem": str(error)}
            finally:
                if opened is not None:
                    self.release(opened, at_once=True)
            took_s = time.monotonic() - started_s
            self._details[name] = state, time.monotonic() + max(FRESH_S, 20 * took_s), details


def _order(name: str) -> tuple[str, int]:
    """Return a key that sorts files in the order in which a recorder created them: ``a_2.mem`` follows ``a.mem``."""
    begin, _, number = name.removesuffix(SUFFIX).rpartition("_")
    return (begin, int(number)) if begin and number.isdecimal() else (name.removesuffix(SUFFIX), 1)


def _serves(opened: Opened, state: _State, since_s: float | None) -> bool:
    """Return whether an open recording can be reused: its file is unchanged, or it was opened recently enough."""
    if opened.state == state:
        return True
    enough = opened.fresh if since_s is None else opened.opened_s >= since_s
    return opened.state.inode == state.inode and enough


def _state(path: Path) -> _State:
    try:
        found = path.lstat()
    except OSError as error:
        raise RecordingError(f"{path.name}: {error.strerror}") from None
    return _State(found.st_ino, found.st_size, found.st_mtime_ns)


def _open(path: Path, state: _State) -> Opened:
    started_s, watch, damage = time.monotonic(), _Watch(), list[str]()

    def damaged(_: Path, place: Any) -> None:
        text = lost(place)
        if len(damage) < MAX_DAMAGE and text not in damage:
            damage.append(text)

    try:
        part = Part(path, damaged, own=True, beat=watch)
        try:
            dump = Dump([part])
        except BaseException:
            part.close()
            raise
    except OSError as error:
        why = "it is a link, and the page does not follow links" if path.is_symlink() else error.strerror
        raise RecordingError(f"{path.name}: {why}") from None
    return Opened(path.name, state, dump, watch, time.monotonic() - started_s, damage)


def _details(opened: Opened) -> dict[str, Any]:
    dump = opened.dump
    return {
        "closed": dump.closed,
        "begin_s": dump.begin_ns / 1e9,
        "end_s": dump.end_ns / 1e9,
        "sources": list(dump.sources),
        "instance": dump.instance,
        "damaged": bool(dump.damage),
    }


def _listed(folder: Path) -> list[tuple[str, _State, bool]]:
    """Return the newest files: the name and state of each, and whether a recorder is writing it."""
    found = []
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            with suppress(OSError):
                if _NAME.fullmatch(entry.name) and stat.S_ISREG((status := entry.stat(follow_symlinks=False)).st_mode):
                    found.append((entry.name, _State(status.st_ino, status.st_size, status.st_mtime_ns)))
    locked = _locked()
    found.sort(key=lambda pair: pair[1].changed_ns, reverse=True)
    return [(name, state, state.inode in locked) for name, state in found[:MAX_LISTED]]


def _locked() -> set[int]:
    """Return the inodes of files that are locked for writing: a recorder locks the file that it writes.

    The locks are read from proc(5). An attempt to lock a file could take the lock from a recorder.
    """
    found = set()
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/locks").read_text().splitlines():
            words = line.split()
            if words[1] == "FLOCK" and words[3] == "WRITE":
                found.add(int(words[5].rpartition(":")[2]))
    return found
