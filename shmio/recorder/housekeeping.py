"""Closes recordings that earlier recorders have left unclosed, and deletes old recordings.

A separate thread does this, so that many files or a slow disk do not delay the recording.
"""

from __future__ import annotations

import fcntl
import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from shmio.config import Recorder as Settings
from shmio.errors import RecordingError
from shmio.recorder.finalise import finalise
from shmio.recorder.previous_recordings import about_of, is_own, own_files
from shmio.recording.reading.reader import Reader

LOOK_S: Final = 60.0
"""Interval in s at which the folder of the recordings is checked."""
DAY_S: Final = 86_400
log = logging.getLogger("shmio.recorder")


class _File(NamedTuple):
    """Identity and size of a file at a check. The file is read again only if they have changed."""

    path: Path
    inode: int
    size: int
    changed_ns: int


class Housekeeper:
    """Thread that closes and deletes recordings.

    The thread changes only recordings of this user and this instance that the same kind of recorder
    (``by``) has written, and never a file that another process is writing.
    """

    def __init__(self, instance: str, settings: Settings, by: str, present: Callable[[], set[Path]]) -> None:
        """Create the thread. ``present`` returns the files that this recorder is writing."""
        self._instance = instance
        self._settings = settings
        self._by = by
        self._present = present
        self._own: dict[_File, bool] = {}
        """The recordings by this kind of recorder. The value is True if the recording is closed."""
        self._strange: set[_File] = set()
        self._undeletable: set[_File] = set()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)

    def start(self) -> None:
        """Start the thread, which checks the folder at once, and then at intervals."""
        self._thread.start()

    def stop(self, patience_s: float = 0.5) -> None:
        """Stop the thread before it handles the next file.

        Wait until it has ended, for at most ``patience_s`` seconds.
        """
        self._stop.set()
        self._thread.join(patience_s)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self.check_folder()
            except Exception:  # an error here must not end the recording
                log.exception("the recorder cannot clean up earlier recordings; it tries again")
            self._stop.wait(LOOK_S)

    def check_folder(self) -> None:
        """Check the folder once: close recordings that were left unclosed, and delete old recordings."""
        present = self._present()
        files = [_file(path) for path in own_files(Path(self._settings.directory), self._instance)]
        found = [file for file in files if file is not None]
        self._own = {file: closed for file, closed in self._own.items() if file in found}
        self._strange &= set(found)
        self._undeletable &= set(found)
        for file in found:
            if self._stop.is_set():
                return
            known = file.path in present or self._own.get(file) or file in self._strange
            if file.size and not known:  # an empty file is new, or its recorder wrote nothing
                self._take_in(file)
        self._delete([file for file in found if file.path in present])

    def _take_in(self, file: _File) -> None:
        try:
            if not about_of(file.path, self._instance, self._by):
                self._strange.add(file)
                return
            with Reader(file.path, own=True) as reader:
                closed = reader.records.footer() is not None
            if not closed and finalise(file.path):
                log.info(
                    "the recorder closed %s, because an earlier recorder died before it could close the file", file.path
                )
                file, closed = _file(file.path) or file, True
            self._own[file] = closed
        except (OSError, RecordingError) as error:
            self._strange.add(file)
            log.warning("the recorder leaves %s unchanged: %s", file.path, error)

    def _delete(self, present: list[_File]) -> None:
        """Delete closed files that are too old.

        Then delete the oldest closed files until all files together are small enough.
        """
        settings = self._settings
        left = sum(file.size for file in (*present, *self._own))
        oldest = sorted((file for file, closed in self._own.items() if closed), key=lambda file: file.changed_ns)
        for file in oldest:
            age_days = (time.time() - file.changed_ns / 1e9) / DAY_S
            if settings.keep_days and age_days > settings.keep_days:
                why = f"it is {age_days:.1f} days old, but recorder.keep_days is {settings.keep_days:g}"
            elif settings.keep_mb and left > settings.keep_mb * 1e6:
                why = f"there are {left / 1e6:.1f} MB of recordings, but recorder.keep_mb is {settings.keep_mb:g}"
            else:
                continue
            if self._remove(file, why):
                left -= file.size

    def _remove(self, file: _File, why: str) -> bool:
        try:
            if _file(file.path) != file or _is_held(file.path):
                return False
            file.path.unlink()
        except OSError as error:
            if file not in self._undeletable:
                self._undeletable.add(file)
                log.warning(
                    "the recorder cannot delete %s: %s; it should be deleted because %s", file.path, error.strerror, why
                )
            return False
        del self._own[file]
        log.info("the recorder deleted %s: %s", file.path, why)
        return True


def _is_held(path: Path) -> bool:
    """Return whether a replay uses the file.

    Such a file must not be deleted, because a restarted replay reads it again.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    finally:
        os.close(fd)
    return False


def _file(path: Path) -> _File | None:
    """Return the file's present state; None if it does not exist or belongs to another user."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return _File(path, found.st_ino, found.st_size, found.st_mtime_ns) if is_own(found) else None
