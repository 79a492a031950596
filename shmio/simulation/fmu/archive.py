"""Checks the archive of an FMU, reads its description, and extracts it.

FMUs come from others, so nothing in the archive is trusted.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
import weakref
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Final

from shmio.errors import ModelError
from shmio.layout.topic import shorten
from shmio.wording import printable

MAX_FILES: Final = 10_000
MAX_BYTES: Final = 1 << 30
"""Maximum size in bytes of all extracted files together."""
MAX_DESCRIPTION_BYTES: Final = 32 << 20
DESCRIPTION: Final = "modelDescription.xml"
_PREFIX: Final = "shmio-fmu-"
_ENCRYPTED: Final = 1
_DAMAGED: Final = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError)


class Archive:
    """The archive of one FMU. The file is open only during a read."""

    def __init__(self, path: Path) -> None:
        """Check the archive, and read its description.

        Raises:
            ModelError: The file cannot be read, is not an archive, or is too large; or a file in it
                has a path that leads out of the archive.

        """
        self.path = path
        with self._opened() as archive:
            self.names = frozenset(archive.namelist())
            if DESCRIPTION not in self.names:
                raise ModelError(f"it has no {DESCRIPTION}, so it is not an FMU")
            size = archive.getinfo(DESCRIPTION).file_size
            if size > MAX_DESCRIPTION_BYTES:
                raise ModelError(f"{DESCRIPTION} has {size} bytes; expected at most {MAX_DESCRIPTION_BYTES}")
            self.description = archive.read(DESCRIPTION)

    def extract(self) -> Extracted:
        """Extract all files into a new folder.

        Raises:
            ModelError: The archive was changed since it was read, or a file cannot be written.

        """
        with self._opened() as archive:
            if archive.read(DESCRIPTION) != self.description:
                raise ModelError("the file was changed while it was loaded; run shmio-supervisor reload")
            folder = Extracted()
            try:
                archive.extractall(folder.path)
            except BaseException:
                folder.remove()
                raise
            return folder

    @contextmanager
    def _opened(self) -> Iterator[zipfile.ZipFile]:
        try:
            if not stat.S_ISREG(self.path.stat().st_mode):
                raise ModelError("it is not a regular file")
            with zipfile.ZipFile(self.path) as archive:
                _check(archive.infolist())
                yield archive
        except OSError as error:
            raise ModelError(error.strerror or str(error)) from None
        except _DAMAGED as error:
            raise ModelError(f"the archive is damaged: {shorten(printable(str(error)))}") from None


def _check(files: list[zipfile.ZipInfo]) -> None:
    """Check the sizes and names of an archive's files.

    ``zipfile`` reads no more of a file than its size says.

    Raises:
        ModelError: The files are too many or too large, or a file is encrypted, is a link, or has a
            path that leads out of the archive.

    """
    if len(files) > MAX_FILES:
        raise ModelError(f"it has {len(files)} files; expected at most {MAX_FILES}")
    if (size := sum(file.file_size for file in files)) > MAX_BYTES:
        raise ModelError(f"its files have {size} bytes; expected at most {MAX_BYTES}")
    for file in files:
        name = file.filename
        if name.startswith("/") or "\\" in file.orig_filename or ".." in PurePosixPath(name).parts:
            raise ModelError(f"the file {shorten(printable(name))!r} would lie outside the archive's folder")
        if file.flag_bits & _ENCRYPTED:
            raise ModelError(f"the file {shorten(printable(name))!r} is encrypted")
        if stat.S_ISLNK(file.external_attr >> 16):
            raise ModelError(f"the file {shorten(printable(name))!r} is a link")


class Extracted:
    """A folder with the files of an FMU, in the folder for temporary files.

    The process holds a lock on the folder. If the process is killed, the next process that extracts
    an FMU removes the folder.
    """

    def __init__(self) -> None:
        """Create the folder, and remove those of killed processes.

        Raises:
            OSError: The folder cannot be created.

        """
        _remove_orphans()
        while True:
            self.path = Path(tempfile.mkdtemp(prefix=_PREFIX))
            with suppress(OSError):  # another process has removed the folder before it was locked
                descriptor = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if self.path.exists():
                    break
        self._remove = weakref.finalize(self, _remove, self.path, descriptor)

    def remove(self) -> None:
        """Remove the folder."""
        self._remove()


def _remove(path: Path, descriptor: int) -> None:
    shutil.rmtree(path, ignore_errors=True)
    os.close(descriptor)


def _remove_orphans() -> None:
    """Remove the folders of processes that have been killed."""
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):  # the folder belongs to another user, or to a running process
            descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if os.fstat(descriptor).st_uid == os.geteuid():
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(descriptor)
