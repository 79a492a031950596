"""Read the log files of a local instance: the last lines of all files, and new lines as they are written."""

from __future__ import annotations

import ctypes
import errno
import heapq
import os
import re
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec

from shmio.logs import with_fields

_LINE = re.compile(
    r"(?P<time>[0-9T:.-]+Z) (?P<level>[A-Z]+) +(?P<process>.+?)\[(?P<pid>[0-9]{1,10})\] (?P<text>.*)", re.DOTALL
)
"""Matches a line of text that :mod:`shmio.logs` has written."""

MAX_LINE_BYTES: Final = 65536
TAIL_BYTES: Final = 65536
"""Size in bytes of the pieces in which a file is read backwards from its end."""
_STAMP = re.compile(rb'(?:\{"time": ?")?(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z)[" ]')
"""Matches the start of a record's line, in text or in JSON."""
_FIRST_STAMP = re.compile(rb"\n(?=" + _STAMP.pattern + rb")")

# inotify(7): events of a folder that concern its log files.
_IN_MODIFY: Final = 0x0002
_IN_MOVED_TO: Final = 0x0080
_IN_CREATE: Final = 0x0100
_EVENT_ROOM: Final = 65536


class _JsonLine(msgspec.Struct):
    """A line that shmio.logs writes as JSON."""

    time: str
    level: str
    process: str
    pid: int
    message: str
    fields: dict[str, Any] = {}
    traceback: str = ""


def parse_line(line: str) -> dict[str, Any]:
    """Split a line, which is text or JSON, into its parts.

    For a continuation line, such as a line of a traceback, all parts except the text are None. For a
    line in JSON, the text includes the fields and the traceback of the record.
    """
    if line.startswith("{"):
        with suppress(msgspec.MsgspecError, RecursionError):
            record = msgspec.json.decode(line, type=_JsonLine)
            text = with_fields(record.message, record.fields)
            if record.traceback:
                text += "\n    " + record.traceback.replace("\n", "\n    ")
            return {
                "time": record.time, "level": record.level, "process": record.process, "pid": record.pid, "text": text
            }  # fmt: skip
    found = _LINE.fullmatch(line)
    if found is None:
        return {"time": None, "level": None, "process": None, "pid": None, "text": line}
    return {**found.groupdict(), "pid": int(found["pid"])}


def as_text(line: str) -> str:
    """Return a line as text. If it is JSON with a traceback, the result has several lines."""
    found = parse_line(line) if line.startswith("{") else None
    if found is None or found["time"] is None:
        return line
    return "{time} {level:<7} {process}[{pid}] {text}".format_map(found)


def last_lines(files: Iterable[Path], count: int) -> list[bytes]:
    """Return the last ``count`` lines of all files together, in the order of their time stamps.

    A line without a time stamp, such as a line of a traceback, follows the line before it in its
    file.
    """
    merged = heapq.merge(*(_stamped(file, count) for file in files), key=lambda entry: entry[0])
    return list(deque((line for _, line in merged), maxlen=count))


def _stamped(file: Path, count: int) -> Iterable[tuple[bytes, bytes]]:
    """Return the last ``count`` lines of a file as (time stamp, line).

    A line without a time stamp gets that of the last line before it that has one.
    """
    try:
        with file.open("rb") as stream:
            stream.seek(_start(stream, count))
            return deque(_lines(stream), maxlen=count)
    except OSError:
        return ()


def _start(stream: BinaryIO, count: int) -> int:
    """Return the offset at which to start to read the last ``count`` lines: that of a line with a time stamp, or 0."""
    at = stream.seek(0, os.SEEK_END)
    lines = 0
    while at > 0:
        at = max(0, at - TAIL_BYTES)
        stream.seek(at)
        data = stream.read(TAIL_BYTES)
        found = _FIRST_STAMP.search(data) if at else None
        if found is not None and lines + data.count(b"\n", found.end()) >= count:
            return at + found.end()
        lines += data.count(b"\n")
    return 0


def _lines(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    stamp = b""
    while line := stream.readline(MAX_LINE_BYTES):
        found = _STAMP.match(line)
        stamp = found[1] if found else stamp
        yield stamp, line.rstrip(b"\r\n")


class Follower:
    """Reads new lines of log files as they are written. Use it as a context manager.

    After a rotation, the follower reads the rest of the old file, then the new file. It waits with
    inotify, so that idle files cost nothing.
    """

    def __init__(self, files: Iterable[Path]) -> None:
        """Begin to follow the files.

        Raises:
            OSError: A folder cannot be watched.

        """
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
        """Wait for a change in the folders of the files, and return the new complete lines."""
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
    """Return whether the path now leads to a file other than the open one."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return False
    return stream is None or found.st_ino != os.fstat(stream.fileno()).st_ino


def _watch(folders: Iterable[Path]) -> int:
    """Return an inotify descriptor for the folders.

    It uses ctypes, because Python has no inotify.
    """
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
