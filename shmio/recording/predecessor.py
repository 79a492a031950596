"""Where the recorder before this one came to: so much of it as is still in the rings need not be missed."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.recording.encoding import EVENT, FRAME
from shmio.recording.follower import Place
from shmio.recording.output import SUFFIX
from shmio.recording.reader import Reader
from shmio.recording.survey import survey
from shmio.segment import Block, Segment

MAX_FILES: Final = 256
"""How many recordings, the newest by their names first, are looked at."""

log = logging.getLogger("shmio.recorder")


def places(directory: Path, segment: Segment, by: str) -> dict[str, Place]:
    """For each source the last frame and event that recorders of this kind (``by``) have of this run of the instance.

    Sources that were not recorded, or had another layout then, are left out.
    """
    found: dict[str, Place] = {}
    for file in _of_this_run(directory, segment, by):
        try:
            with Reader(file) as reader:
                found = _places(reader, segment.blocks) | found
        except (OSError, RecordingError) as error:
            log.warning("it is not known where the recording before ended: %s", error)
            continue
        if found.keys() >= segment.blocks.keys():
            break
    return found


def _of_this_run(directory: Path, segment: Segment, by: str) -> list[Path]:
    """The recordings of this run, the newest first; not by name, for the host's clock may go back."""
    run = {"instance": segment.instance, "epoch": f"{segment.header.epoch:016x}", "recorder": by}
    found: list[tuple[int, Path]] = []
    for file in sorted(directory.glob(f"{segment.instance}-*{SUFFIX}"), reverse=True)[:MAX_FILES]:
        try:
            with Reader(file) as reader:
                about = _about(reader)
            if about.items() >= run.items():
                found.append((int(about["recording_ns"]), file))
        except (OSError, RecordingError, KeyError, ValueError) as error:
            log.warning("%s is passed over: %s", file, error)
    return [file for _, file in sorted(found, reverse=True)]


def _about(reader: Reader) -> dict[str, str]:
    """What the recorder said of the instance, at the very beginning."""
    for record in reader.records.walk():
        if record.opcode == Opcode.METADATA:
            reader.note(record)
        if record.opcode == Opcode.CHUNK or reader.about:
            break
    return reader.about


def _places(reader: Reader, blocks: dict[str, Block]) -> dict[str, Place]:
    found = survey(reader)
    last: dict[str, dict[str, tuple[int, int]]] = {}  # by source and encoding: number, log time; the last block's
    for track in found.tracks.values():
        channel = track.channel
        block = blocks.get(channel.source)
        if channel.encoding not in (FRAME, EVENT) or block is None or block.layout.hash.hex() != channel.layout:
            continue
        what = "frames" if channel.encoding == FRAME else "events"
        missed_to = found.missed_to.get((channel.source, channel.block, what), 0)
        number = max(track.numbers(reader)[1], missed_to)
        if number <= (block.ring.head() if what == "frames" else block.events.head()):
            last.setdefault(channel.source, {})[what] = number, track.last_ns
    return {
        source: Place(
            sides.get("frames", (0, 0))[0],
            sides.get("events", (0, 0))[0],
            max(log_ns for _, log_ns in sides.values()),
        )
        for source, sides in last.items()
    }
