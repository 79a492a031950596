"""Finds recordings of earlier recorders, and the position at which the last recording ended."""

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

from shmio.errors import RecordingError
from shmio.recorder.file_output import SUFFIX
from shmio.recording.format.encoding import EVENT, FRAME, BlockPosition
from shmio.recording.reading.reader import Reader
from shmio.recording.reading.survey import survey
from shmio.segment import Block, Segment

ABOUT_BYTES: Final = 1 << 20
"""Number of bytes to read at the start of a file, to find the metadata about the instance."""
MAX_FILES: Final = 256
"""Maximum number of recordings to check; those with the newest names are checked."""

log = logging.getLogger("shmio.recorder")


def own_files(directory: Path, instance: str) -> list[Path]:
    """Return the files whose names are those of recordings of this instance.

    Leave out files that are not regular files of this user, and log a warning about them.
    """
    name = re.compile(rf"{re.escape(instance)}-\d{{8}}T\d{{6}}Z(_\d+)?{re.escape(SUFFIX)}")  # does not match a50-test
    found: list[Path] = []
    strange: list[Path] = []
    for file in directory.glob(f"{instance}-*{SUFFIX}"):
        if name.fullmatch(file.name):
            with suppress(OSError):  # it was removed meanwhile
                (found if is_own(file.lstat()) else strange).append(file)
    if strange:
        more = f" and {len(strange) - 1} more" if len(strange) > 1 else ""
        log.warning("the recorder ignores %s%s: this is not a regular file of this user", strange[0], more)
    return found


def is_own(status: os.stat_result) -> bool:
    """Return whether a file is a regular file of this user, according to its status."""
    return stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid()


def about_of(file: Path, instance: str, by: str, beat: Callable[[], object] = lambda: None) -> dict[str, str]:
    """Read the metadata that a recorder wrote about its instance.

    Args:
        file: The file.
        instance: Name of the instance.
        by: Kind of recorder.
        beat: Called at intervals, so that the process can write its heartbeat.

    Returns:
        The metadata. It is empty if another instance or another kind of recorder wrote the file, or
        if it was made from other recordings.

    Raises:
        OSError: The file is not a regular file of this user, or cannot be read.
        RecordingError: The file is not a recording.
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


def last_positions(
    directory: Path, segment: Segment, by: str, beat: Callable[[], object] = lambda: None
) -> dict[int, BlockPosition]:
    """Find the last recorded frame and event of each block, in recordings of this run.

    Args:
        directory: Directory of the recordings.
        segment: The instance's segment.
        by: Kind of recorder.
        beat: Called at intervals, so that the process can write its heartbeat.

    Returns:
        The positions, by the section of each block. A block that was not recorded is missing.
    """
    found: dict[int, BlockPosition] = {}
    blocks = {block.section: block for block in (*segment.ended, *segment.blocks.values())}
    for file in _of_this_run(directory, segment, by, beat):
        beat()
        try:
            with Reader(file, own=True, beat=beat) as reader:
                found = _positions(reader, blocks) | found
        except (OSError, RecordingError) as error:
            log.warning("the recorder cannot find where its previous recording ended: %s", error)
        if found.keys() >= blocks.keys():
            break
    return found


def trigger_interrupted(directory: Path, segment: Segment, by: str, beat: Callable[[], object] = lambda: None) -> bool:
    """Return whether the previous recorder died while it wrote a triggered recording.

    The arguments are as for :func:`last_positions`.
    """
    for file in _of_this_run(directory, segment, by, beat)[:1]:
        with suppress(OSError, RecordingError), Reader(file, own=True, beat=beat) as reader:
            return reader.records.footer() is None and "trigger" in about_of(file, segment.instance, by)
    return False


def _of_this_run(directory: Path, segment: Segment, by: str, beat: Callable[[], object]) -> list[Path]:
    """Return the recordings of this run of the instance, from the newest to the oldest.

    They are sorted by the monotonic time at which they began. Their names may be in another order,
    because the host's clock may have been set back.
    """
    epoch = f"{segment.header.epoch:016x}"
    found: list[tuple[int, Path]] = []
    for file in sorted(own_files(directory, segment.instance), reverse=True)[:MAX_FILES]:
        beat()
        try:
            about = about_of(file, segment.instance, by, beat)
            if about.get("epoch") == epoch:
                found.append((int(about["recording_ns"]), file))
        except (OSError, RecordingError, KeyError, ValueError) as error:
            log.warning("the recorder ignores the earlier recording %s: %s", file, error)
    return [file for _, file in sorted(found, reverse=True)]


def _positions(reader: Reader, blocks: dict[int, Block]) -> dict[int, BlockPosition]:
    """Return the position of each block at the end of a file.

    For a block without intact entries, this is the position at the start of the file.
    """
    found = survey(reader)
    positions = {section: place for section, place in reader.places.items() if section in blocks}
    for channel in reader.channels.values():
        block = blocks.get(channel.section)
        if block is None or channel.source != block.source or channel.encoding not in (FRAME, EVENT):
            continue
        what = "frames" if channel.encoding == FRAME else "events"
        track = found.tracks.get(channel.number)
        number = channel.after
        if track:
            try:
                number = track.last(reader)
            except RecordingError as error:
                log.warning(
                    "the end of the previous recording is damaged, so its last entries are recorded again: %s", error
                )
                track = None
        number = max(number, found.missed_to.get((channel.source, channel.block, what), 0))
        frame, event, log_ns = positions.get(channel.section, BlockPosition())
        log_ns = max(log_ns, track.last_ns if track else 0)
        if channel.encoding == FRAME:
            positions[channel.section] = BlockPosition(number, event, log_ns)
        else:
            positions[channel.section] = BlockPosition(frame, number, log_ns)
    return {
        section: place
        for section, place in positions.items()
        if place.frame <= blocks[section].ring.head() and place.event <= blocks[section].events.head()
    }
