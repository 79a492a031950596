"""Answers requests to save, check or restore the state of this process, for snapshots."""

from __future__ import annotations

import errno
import logging
import os
import re
import stat
from pathlib import Path
from typing import BinaryIO, Final, Protocol

from shmio.errors import ShmioError, SnapshotError
from shmio.segment.clock import ClockPage, StateAction, StateRequest

MAX_PART_BYTES: Final = 256 << 20
"""Maximum size of the state of one process, in bytes."""
PART, REFUSAL = ".part", ".refused"
"""Suffixes of the file with a process's state, and of the file with the reason for its refusal."""
WORK: Final = re.compile(r"\.work-[0-9a-f]{16}")

log = logging.getLogger("shmio.snapshot")


class StateKeeper(Protocol):
    """An object that saves and restores the state of a process. Its methods raise ShmioError to refuse."""

    def save(self, name: str) -> bytes:
        """Return the present state, encoded, for the snapshot ``name``."""

    def check(self, data: bytes) -> None:
        """Check, without any change, whether an encoded state can be restored."""

    def restore(self, data: bytes, name: str) -> None:
        """Restore an encoded state from the snapshot ``name``."""


class StateRequests:
    """Serves the requests of the clock page for one process. Use it in one thread, between two steps."""

    def __init__(self, page: ClockPage, slot: int, name: str, folder: Path, keeper: StateKeeper) -> None:
        """Start with the next request.

        Args:
            page: The clock page.
            slot: Index of the process's slot.
            name: Name of the process.
            folder: The instance's folder of snapshots.
            keeper: Has the state.
        """
        self._page, self._slot, self._name, self._folder, self._keeper = page, slot, name, folder, keeper
        self._answered = page.state_request().number

    def serve(self) -> None:
        """Carry out and answer the last request, unless it was answered before."""
        request = self._page.state_request()
        if request.number == self._answered:
            return
        self._answered = request.number
        done = bool(WORK.fullmatch(request.folder)) and self._carry_out(request, self._folder / request.folder)
        self._page.answer_state(self._slot, request.number, done=done)

    def _carry_out(self, request: StateRequest, folder: Path) -> bool:
        """Carry out a request. Return whether that worked; if not, write the reason to a file."""
        part = folder / f"{self._name}{PART}"
        try:
            match request.action:
                case StateAction.SAVE:
                    write_new(part, self._keeper.save(request.name))
                case StateAction.CHECK:
                    self._keeper.check(read_bounded(part, MAX_PART_BYTES))
                case StateAction.RESTORE:
                    self._keeper.restore(read_bounded(part, MAX_PART_BYTES), request.name)
        except ShmioError as error:
            _refuse(folder / f"{self._name}{REFUSAL}", str(error))
        except OSError as error:
            _refuse(folder / f"{self._name}{REFUSAL}", f"{part}: {error.strerror}")
        except Exception as error:
            log.exception("the process failed to save, check or restore its state")
            _refuse(folder / f"{self._name}{REFUSAL}", f"{type(error).__name__}: {error}")
        else:
            return True
        return False


def _refuse(file: Path, reason: str) -> None:
    try:
        write_new(file, reason[:4000].encode())
    except OSError as error:
        log.warning("the state was neither saved nor restored: %s (%s)", reason, error.strerror)


def write_new(file: Path, *data: bytes, sync: bool = False) -> None:
    """Write a file that does not exist yet; with ``sync``, wait until it is on the disk. Raise OSError on failure."""
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    with os.fdopen(descriptor, "wb") as stream:
        stream.writelines(data)
        stream.flush()
        if sync:
            os.fsync(stream.fileno())


def open_file(file: Path) -> BinaryIO:
    """Open a regular file to read it. For any other kind of file, such as a FIFO, raise OSError at once."""
    stream = open(file, "rb", opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK))  # noqa: SIM115
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError(errno.EINVAL, "not a regular file")
    return stream


def read_bounded(file: Path, most: int) -> bytes:
    """Return the content of a file.

    Raises:
        SnapshotError: The file has more than ``most`` bytes.
        OSError: The file cannot be read.
    """
    with open_file(file) as stream:
        data = stream.read(most + 1)
    if len(data) > most:
        raise SnapshotError(f"{file} has more than {most} bytes")
    return data
