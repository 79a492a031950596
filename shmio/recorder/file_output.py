"""Writes a recording's file in a separate thread, so a slow disk does not delay the recorder."""

from __future__ import annotations

import fcntl
import os
import threading
import time
from collections import deque
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from shmio.config.folder import FULL
from shmio.errors import RecordingError

RETRY_S: Final = 0.5
"""Time in s between attempts after a failed write."""
WAIT_S: Final = 0.02
"""Interval in s at which the output of a file checks whether the previous file is complete."""
SLOW_S: Final = 2.0
"""A write that takes longer than this time in s is reported as a problem."""
SUFFIX: Final = ".mem"
_NAMES: Final = 1000


def create(directory: Path, instance: str, now: datetime | None = None) -> tuple[Path, int]:
    """Create a file that is named after the instance and the time (UTC), and its directory if needed.

    The function never changes an existing file. Only this user may read the new file.

    Args:
        directory: Directory of the file.
        instance: Name of the instance.
        now: The time for the name; None: the present time.

    Returns:
        The path and the file descriptor.

    Raises:
        RecordingError: No file can be created.
    """
    stem = f"{instance}-{(now or datetime.now(UTC)).strftime('%Y%m%dT%H%M%SZ')}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for number in range(1, _NAMES):
            path = directory / f"{stem}{f'_{number}' if number > 1 else ''}{SUFFIX}"
            with suppress(FileExistsError):
                return path, os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise RecordingError(f"cannot create a recording in {directory}: {error.strerror}") from None
    raise RecordingError(f"cannot create a recording in {directory}: all names for this second are taken")


class Output:
    """Queues bytes from one thread, and writes them to a file in another thread.

    The bytes between two calls of :meth:`flush` are a piece. The file contains only whole pieces:
    if the disk is full, the thread removes an incomplete piece from the file, and writes the piece
    again later. The file is locked (flock) while it is being written, so that no process takes it
    for the file of a dead recorder.
    """

    def __init__(
        self, path: Path, fd: int, *, limit_bytes: int, fsync_s: float = 0.0, after: Output | None = None
    ) -> None:
        """Lock the file, and start the thread.

        Args:
            path: Path of the file.
            fd: Descriptor of the file.
            limit_bytes: If more bytes than this wait for the disk, the output is :attr:`full`.
            fsync_s: Time between two fsyncs; 0 for an fsync only at the end.
            after: The output of the previous file. This file is written only when that one is
                complete.
        """
        with suppress(OSError):  # a file system without locks
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self.path = path
        self.error = ""
        """Reason why the last write failed; empty if it succeeded."""
        self._remedy = ""
        self.doubt = ""
        """Reason why bytes of the file may be lost; empty if no fsync has failed.

        The reason is never cleared. After a failed fsync the kernel counts the pages as written, so
        a later fsync of this file does not report the failure again.
        """
        self.written = 0
        """Number of bytes in the file."""
        self.synced = 0
        """Number of bytes that an fsync has confirmed. It does not grow after a failed fsync."""
        self._fd = fd
        self._limit = limit_bytes
        self._fsync_s = fsync_s
        self._piece = bytearray()
        self._given = 0
        self._full = False
        self._pieces: deque[bytes] = deque()
        self._condition = threading.Condition()
        self._after = after
        self.whole = False
        """True if the file is complete: all bytes were written, and no more will come."""
        self._ending = False
        self._closing = False
        self._busy_since_s: float | None = None
        self._synced_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    # ---- called by the recorder's thread -----------------------------------------------------------------------------

    def write(self, data: bytes | memoryview) -> int:
        """Append data to the present piece, without waiting for the disk; return the number of bytes."""
        self._piece += data
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes passed to :meth:`write` so far."""
        return self._given + len(self._piece)

    def flush(self) -> None:
        """End the present piece, and queue it for writing."""
        if self._piece:
            self._given += len(self._piece)
            with self._condition:
                self._pieces.append(bytes(self._piece))
                self._condition.notify()
            self._piece.clear()

    @property
    def waiting(self) -> int:
        """Number of bytes that are not in the file yet."""
        return self.tell() - self.written

    @property
    def full(self) -> bool:
        """True if more than ``limit_bytes`` bytes wait for the disk.

        It then stays True until at most half of ``limit_bytes`` wait.
        """
        self._full = self.waiting > (self._limit // 2 if self._full else self._limit)
        return self._full

    @property
    def problem(self) -> str:
        """The present problem of the file or its disk, with the path; empty if there is none."""
        since_s = self._busy_since_s
        if self.error:
            return f"{self.path}: {self.error}{self._remedy}"
        if self.doubt:
            return f"{self.path}: {self.doubt}"
        if since_s is not None and time.monotonic() - since_s > SLOW_S:
            return f"{self.path}: the disk has not answered for {time.monotonic() - since_s:.0f} s"
        return ""

    def check(self) -> None:
        """Raise RecordingError if the file was removed, so that further data would be lost."""
        if os.fstat(self._fd).st_nlink == 0:
            raise RecordingError(f"{self.path} was removed while it was being written")

    def end(self) -> None:
        """Accept no more bytes.

        The thread writes the waiting bytes, however long the disk takes.
        """
        self.flush()
        with self._condition:
            self._ending = True
            self._condition.notify()

    @property
    def ended(self) -> bool:
        """True if the thread has ended, so that :meth:`close` does not wait."""
        return not self._thread.is_alive()

    def close(self, patience_s: float) -> bool:
        """End the file, and wait at most ``patience_s`` seconds until all waiting bytes are written.

        Return whether all bytes of the file are safely on the disk.
        """
        self.flush()
        with self._condition:
            self._ending = self._closing = True
            self._condition.notify()
        self._thread.join(patience_s)
        if self._thread.is_alive():
            self.error = self.error or "the disk does not answer"
            return False
        whole = self.written == self._given and not self.error and not self.doubt
        os.close(self._fd)
        return whole

    # ---- run by the writing thread -----------------------------------------------------------------------------------

    def _run(self) -> None:
        if not self._is_next():
            return
        while True:
            with self._condition:
                while not self._pieces and not self._ending:
                    self._condition.wait()
                if not self._pieces:
                    break
                piece = self._pieces[0]
            if self._put(piece):
                with self._condition:
                    self._pieces.popleft()
                    self.written += len(piece)
                if self._fsync_s and time.monotonic() - self._synced_s >= self._fsync_s:
                    self._sync()
            elif not self._wait():
                break
        self.whole = not self._pieces
        self._sync()

    def _is_next(self) -> bool:
        """Wait until the previous file has ended. Return False if that file is not complete."""
        after, self._after = self._after, None
        while after is not None and not (after.whole or after.ended or self._closing):
            after._thread.join(WAIT_S)
        if after is None or after.whole:
            return True
        self.error = f"the previous file, {after.path}, was not written completely"
        return False

    def _put(self, piece: bytes) -> bool:
        """Write a whole piece. If that fails, remove its written part, and return False."""
        self._busy_since_s = time.monotonic()
        view, at = memoryview(piece), 0
        try:
            while at < len(piece):
                at += os.pwrite(self._fd, view[at:], self.written + at)
        except OSError as error:
            self._remedy = "; make room, and the recorder continues" if error.errno in FULL else ""
            self.error = error.strerror or str(error)
            with suppress(OSError):
                os.ftruncate(self._fd, self.written)
            return False
        finally:
            self._busy_since_s = None
        self.error = self._remedy = ""
        return True

    def _wait(self) -> bool:
        """Wait before the next attempt. Return False if the file is being closed."""
        with self._condition:
            if not self._closing:
                self._condition.wait_for(lambda: self._closing, RETRY_S)
                return True
        return False

    def _sync(self) -> None:
        self._busy_since_s = time.monotonic()
        try:
            os.fsync(self._fd)
        except OSError as error:
            reason = error.strerror or str(error)
            self.doubt = self.doubt or f"fsync failed ({reason}): the data after byte {self.synced} may be lost"
        else:
            if not self.doubt:
                self.synced = self.written
        self._busy_since_s = None
        self._synced_s = time.monotonic()
