"""The folder of an archive: one process writes it."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
from pathlib import Path
from typing import Final

from shmio.errors import RecordingError

_LOCK: Final = ".archive"


class ArchiveFolder:
    """A folder that this process has locked.

    Attributes:
        path: The folder.
        identity: A random text that names the archive at the servers.

    """

    def __init__(self, path: Path) -> None:
        """Create the folder if it does not exist, and lock it.

        Raises:
            RecordingError: Another process writes it.
            OSError: It cannot be created or written.

        """
        path.mkdir(parents=True, exist_ok=True)
        self.path = path
        file = path / _LOCK
        self._fd = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise RecordingError(
                    f"{path}: another shmio fabric archive writes this folder; choose another folder"
                ) from None
            text = os.pread(self._fd, 64, 0).decode("ascii", "replace")
            if not re.match(r"[0-9a-f]{16}\Z", text):
                text = secrets.token_hex(8)
                os.pwrite(self._fd, text.encode(), 0)
                os.fsync(self._fd)
            self.identity = text
        except BaseException:
            os.close(self._fd)
            raise

    def close(self) -> None:
        """Unlock the folder."""
        os.close(self._fd)
