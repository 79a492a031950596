"""Checks whether a folder is writable, by writing to it.

Permissions do not show whether a disk is full or read-only.
"""

from __future__ import annotations

import errno
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_PROBE: Final = bytes(4096)  # an empty file fits even on a full disk
FULL: Final = (errno.ENOSPC, errno.EDQUOT)
"""The errors of a full disk."""
_NO_UNNAMED: Final = (errno.EOPNOTSUPP, errno.EISDIR)
_MEANING: Final = {
    errno.ENOENT: "its file system accepts no files; choose another folder",
    errno.EROFS: "it is mounted read-only; remount it, or choose another folder",
    errno.ENOSPC: "the disk is full; make room, or choose another folder",
    errno.EDQUOT: "the disk quota is used up; make room, or choose another folder",
    errno.EACCES: "this user has no permission; let this user write there, or choose another folder",
    errno.EPERM: "this user has no permission; let this user write there, or choose another folder",
}


@dataclass(frozen=True, slots=True)
class Obstacle:
    """Why a folder is not writable, with the remedy.

    ``full`` is True if the reason is a full disk, which may change at any time.
    """

    reason: str
    full: bool = False


def unwritable(folder: Path) -> Obstacle | None:
    """Return why files cannot be created in a folder; None if they can.

    If the folder does not exist yet, check its nearest existing parent. The check leaves no file
    behind, and may take long on a slow file system.
    """
    try:
        place = next(path for path in (folder, *folder.parents) if path.exists())
    except OSError as error:  # such as a name that is too long, or a parent without permission
        return Obstacle(f"{folder}: {error.strerror}")
    if not place.is_dir():
        return Obstacle(f"{place} is not a directory")
    try:
        _write(place)
    except OSError as error:
        what = f"{folder} cannot be written" if place == folder else f"{folder} cannot be created in {place}"
        return Obstacle(f"{what}: {_MEANING.get(error.errno or 0, error.strerror)}", error.errno in FULL)
    return None


def _write(folder: Path) -> None:
    try:
        descriptor = os.open(folder, os.O_TMPFILE | os.O_WRONLY | os.O_CLOEXEC, 0o600)
    except OSError as error:
        if error.errno not in _NO_UNNAMED:
            raise
        descriptor, name = tempfile.mkstemp(prefix=".shmio-", dir=folder)
        Path(name).unlink()
    with os.fdopen(descriptor, "wb", buffering=0) as file:
        file.write(_PROBE)
