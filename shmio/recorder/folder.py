"""Which files in a folder are a recorder's own."""

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
"""What a recorder says of the instance is its file's second record: far before this byte."""

log = logging.getLogger("shmio.recorder")


def own_files(directory: Path, instance: str) -> list[Path]:
    """Regular files of this user that are named as recordings of this instance are.

    What others may have put into the folder says nothing, and is not touched.
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
        log.warning("%s%s passed over: no regular file of this user", strange[0], more)
    return found


def is_own(status: os.stat_result) -> bool:
    """Whether it is a regular file of this user."""
    return stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid()


def about_of(file: Path, instance: str, by: str, beat: Callable[[], object] = lambda: None) -> dict[str, str]:
    """What a recorder of this kind (``by``) said of this instance at the beginning of its file; {}: it is no such file.

    One that was made of others is none. OSError, RecordingError: it is not this user's regular file, or no recording.
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
