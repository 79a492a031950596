"""Watches the folder of the log files. ``status`` shows its problems, because no log can."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path
from typing import Final

from shmio.config.folder import unwritable

LOOK_S: Final = 5.0
"""How often the folder is checked."""
SILENT_S: Final = 15.0
"""A disk that does not answer for this long is a problem."""


class LogFolder:
    """Checks from time to time whether the folder is writable, in a thread as a disk may hang."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._looking: threading.Thread | None = None
        self._begun_ns: int | None = None
        self._found = ""

    def problem(self, now_ns: int) -> str:
        """Return the problem found last; empty if there is none."""
        waited_s = 0.0 if self._begun_ns is None else (now_ns - self._begun_ns) / 1e9
        if self._looking is not None and self._looking.is_alive():
            return f"log_dir: {self._folder}: the disk does not answer" if waited_s > SILENT_S else self._found
        if self._begun_ns is None or waited_s >= LOOK_S:
            self._begun_ns = now_ns
            self._looking = threading.Thread(target=self._look, name="log folder", daemon=True)
            with suppress(RuntimeError):  # the host cannot start a thread now: try again later
                self._looking.start()
        return self._found

    def _look(self) -> None:
        obstacle = unwritable(self._folder)
        self._found = f"log_dir: {obstacle.reason}; log lines are lost until that is fixed" if obstacle else ""
