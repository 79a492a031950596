"""Writes an instance's audit files. Several processes can append and rotate without losing a line."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

LOCK_S: Final = 2.0
"""Maximum time in s to wait while another process holds the lock on the file. A write holds it briefly."""
_LOCK_TURN_S: Final = 0.002


class AuditSettings(msgspec.Struct, frozen=True):
    """Where the audit log is, and how many files are kept.

    Attributes:
        path: The newest file.
        max_bytes: Size in bytes up to which the newest file grows before a new one is started.
        files: Number of files to keep, including the newest.

    """

    path: str
    max_bytes: int
    files: int


def file_paths(newest: Path, files: int) -> list[Path]:
    """Return the paths that an audit log of ``files`` files uses, the newest first."""
    return [newest, *(newest.with_name(f"{newest.name}.{number}") for number in range(1, files))]


class AuditFile:
    """Appends lines to the newest file of an audit log. Use it from one thread.

    Each write holds a lock on the file, so that lines of several processes do not mix, and that
    only one process rotates. If a process is killed, the kernel releases its lock. A failed write
    leaves the file as it was, without a part of a line.
    """

    def __init__(self, settings: AuditSettings) -> None:
        """Prepare to write. The first write opens the file."""
        self._paths = file_paths(Path(settings.path), settings.files)
        self._max_bytes = settings.max_bytes
        self._fd = -1

    def append(self, lines: bytes) -> None:
        """Append complete lines.

        Raises:
            OSError: The lines could not be written, for example because the disk is full. The file
                is unchanged.

        """
        self._lock()
        try:
            size = os.fstat(self._fd).st_size
            if size and size + len(lines) > self._max_bytes:
                self._rotate()
                size = os.fstat(self._fd).st_size
            self._write(lines, size)
        finally:
            if self._fd >= 0:
                fcntl.flock(self._fd, fcntl.LOCK_UN)

    def close(self) -> None:
        """Close the file. The next :meth:`append` opens it again."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _lock(self) -> None:
        """Lock the newest file. If it was rotated or removed meanwhile, open the new one."""
        until_s = time.monotonic() + LOCK_S
        while True:
            if self._fd < 0:
                self._open()
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > until_s:
                    raise OSError(errno.EAGAIN, "another process has locked the file", str(self._paths[0])) from None
                time.sleep(_LOCK_TURN_S)
                continue
            with suppress(FileNotFoundError):
                if os.path.samestat(self._paths[0].stat(), os.fstat(self._fd)):
                    return
            self.close()

    def _open(self) -> None:
        newest = self._paths[0]
        newest.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW
        self._fd = os.open(newest, flags, 0o600)

    def _rotate(self) -> None:
        """Rename each file to the next number, remove the oldest file, and start a new one.

        Call this only while you hold the lock. The newest file is renamed last, so that no other
        process can rotate meanwhile.
        """
        for older, newer in zip(reversed(self._paths), reversed(self._paths[:-1]), strict=False):
            with suppress(FileNotFoundError):
                newer.replace(older)
        if len(self._paths) == 1:
            self._paths[0].unlink()
        self.close()
        self._lock()

    def _write(self, lines: bytes, size: int) -> None:
        if size and os.pread(self._fd, 1, size - 1) != b"\n":  # a process was killed while it wrote
            lines = b"\n" + lines
        rest = memoryview(lines)
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._fd, size)
            raise
