"""Closes recordings that their recorder could not close.

Nothing that is whole is touched. Cut off is only what the recorder was within as it died: a part of a record, indexes
that follow the last chunk and are made anew, an end that an earlier attempt at this has begun. So whoever is killed
here leaves what the next one can do again.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

from shmio.dump.reader import Reader
from shmio.recording.ending import Ending


def finalise(file: Path, beat: Callable[[], object] = lambda: None) -> bool:
    """Close a file of this user's recorder; False if somebody is still writing it.

    ``beat`` is called now and then. RecordingError: it is no recording, or damaged in a way that only ``recover`` may
    judge. OSError: there is no room; then it is as it was but for what was cut off.
    """
    with Reader(file, own=True, beat=beat) as reader:
        fd = os.open(file, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            before = os.fstat(fd)
            if before.st_size != reader.records.size:
                return False
            _write(fd, Ending(reader))
            os.utime(fd, ns=(before.st_atime_ns, before.st_mtime_ns))  # nothing was recorded since
        finally:
            os.close(fd)
    return True


def _write(fd: int, ending: Ending) -> None:
    """Cut off, and append."""
    data = ending.data()
    os.ftruncate(fd, ending.cut)
    try:
        done = 0
        while done < len(data):
            done += os.pwrite(fd, data[done:], ending.cut + done)
        os.fsync(fd)
    except OSError:
        os.ftruncate(fd, ending.cut)
        raise
