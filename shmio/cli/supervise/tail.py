"""The end of several log files as one, and what is added to them."""

from __future__ import annotations

import ctypes
import errno
import heapq
import os
import re
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Final

MAX_LINE_BYTES: Final = 65536
_STAMP = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z ")

# inotify(7): what can happen to a log file as seen from its folder.
_IN_MODIFY: Final = 0x0002
_IN_MOVED_TO: Final = 0x0080
_IN_CREATE: Final = 0x0100
_EVENT_ROOM: Final = 65536


def last_lines(files: Iterable[Path], count: int) -> list[bytes]:
    """The last ``count`` lines of the files together, in order of their time stamps.

    A line without a stamp, as those of a traceback, stays behind the one before it.
    """
    merged = heapq.merge(*(_stamped(file, count) for file in files), key=lambda entry: entry[0])
    return list(deque((line for _, line in merged), maxlen=count))


def _stamped(file: Path, count: int) -> Iterable[tuple[bytes, bytes]]:
    """The last ``count`` lines of one file, each with its time stamp or that of the line it follows."""
    try:
        with file.open("rb") as stream:
            return deque(_lines(stream), maxlen=count)
    except OSError:
        return ()


def _lines(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    stamp = b""
    while line := stream.readline(MAX_LINE_BYTES):
        found = _STAMP.match(line)
        stamp = found[0] if found else stamp
        yield stamp, line.rstrip(b"\r\n")


class Follower:
    """What is added to log files from now on; a file that is rotated is read to its end, then anew.

    Waits on inotify, so it costs nothing while nothing is written. Use ``with``.
    """

    def __init__(self, files: Iterable[Path]) -> None:
        """OSError: the folder cannot be watched."""
        self._files: dict[Path, BinaryIO | None] = {}
        self._partial: dict[Path, bytes] = {}
        files = list(files)
        self._fd = _watch({file.parent for file in files})
        for file in files:
            stream = _open(file)
            if stream is not None:
                stream.seek(0, os.SEEK_END)
            self._files[file] = stream
            self._partial[file] = b""

    def __enter__(self) -> Follower:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)
        for stream in self._files.values():
            if stream is not None:
                stream.close()

    def wait(self) -> list[bytes]:
        """Wait until something happens in the folder; the whole lines that are new."""
        os.read(self._fd, _EVENT_ROOM)
        return [line for file in self._files for line in self._new(file)]

    def _new(self, file: Path) -> list[bytes]:
        data = self._partial[file]
        stream = self._files[file]
        if stream is not None:
            data += stream.read()
        if _replaced(file, stream):
            if stream is not None:
                stream.close()
            stream = self._files[file] = _open(file)
            if stream is not None:
                data += stream.read()
        *lines, rest = data.split(b"\n")
        if len(rest) > MAX_LINE_BYTES:
            lines.append(rest)
            rest = b""
        self._partial[file] = rest
        return lines


def _open(file: Path) -> BinaryIO | None:
    try:
        return file.open("rb")
    except FileNotFoundError:
        return None


def _replaced(file: Path, stream: BinaryIO | None) -> bool:
    """Whether the name leads to another file by now."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return False
    return stream is None or found.st_ino != os.fstat(stream.fileno()).st_ino


def _watch(folders: Iterable[Path]) -> int:
    """An inotify descriptor for the folders; the standard library has no binding."""
    libc = ctypes.CDLL(None, use_errno=True)
    fd: int = libc.inotify_init1(os.O_CLOEXEC)
    if fd < 0:
        raise OSError(ctypes.get_errno(), f"cannot follow files: {os.strerror(ctypes.get_errno())}")
    for folder in folders:
        if libc.inotify_add_watch(fd, os.fsencode(folder), _IN_MODIFY | _IN_MOVED_TO | _IN_CREATE) < 0:
            number = ctypes.get_errno()
            os.close(fd)
            hint = "too many watches (fs.inotify.max_user_watches)" if number == errno.ENOSPC else os.strerror(number)
            raise OSError(number, hint, str(folder))
    return fd
