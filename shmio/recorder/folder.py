"""Find a recorder's own files in a folder."""

from __future__ import annotations

import logging
import os
import re
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode

from shmio.recorder.output import SUFFIX
from shmio.recording.reading.reader import Reader

ABOUT_BYTES: Final = 1 << 20
"""How far to read for the metadata about the instance, which is the second record of a file."""

log = logging.getLogger("shmio.recorder")


def own_files(directory: Path, instance: str) -> list[Path]:
    """Return the regular files of this user with names of recordings of this instance.

    Files of other users are logged, and never touched.
    """
    name = re.compile(rf"{re.escape(instance)}-\d{{8}}T\d{{6}}Z(_\d+)?{re.escape(SUFFIX)}")  # not of a50-test
    found: list[Path] = []
    strange: list[Path] = []
    for file in directory.glob(f"{instance}-*{SUFFIX}"):
        if name.fullmatch(file.name):
            with suppress(OSError):  # removed just now
                (found if is_own(file.lstat()) else strange).append(file)
    if strange:
        more = f", and {len(strange) - 1} others," if len(strange) > 1 else ""
        log.warning("%s%s ignored: not a regular file of this user", strange[0], more)
    return found


def is_own(status: os.stat_result) -> bool:
    """Whether a status is that of a regular file of this user."""
    return stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid()


def about_of(file: Path, instance: str, by: str, beat: Callable[[], object] = lambda: None) -> dict[str, str]:
    """Read the metadata that a recorder wrote about its instance.

    Args:
        file: The file.
        instance: Name of the instance.
        by: Kind of recorder.
        beat: Called regularly, as a sign of life.

    Returns:
        The metadata; empty if the file is of another instance or kind of recorder, or was made from
        other recordings.

    Raises:
        OSError: The file is not a regular file of this user, or cannot be read.
        RecordingError: It is not a recording.
    """
    with Reader(file, own=True, beat=beat) as reader:
        for record in reader.records.walk(to=ABOUT_BYTES):
            if record.opcode == Opcode.METADATA:
                reader.note(record)
            if record.opcode == Opcode.CHUNK or reader.about:
                break
        about = reader.about
    ours = about.items() >= {"instance": instance, "recorder": by}.items() and "made_by" not in about
    return about if ours else {}
