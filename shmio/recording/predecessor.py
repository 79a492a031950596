"""Where the recorder before this one came to: so much of it as is still in the rings need not be missed."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from shmio.errors import RecordingError
from shmio.recording.encoding import EVENT, FRAME
from shmio.recording.follower import Place
from shmio.recording.output import SUFFIX
from shmio.recording.reader import Reader
from shmio.recording.survey import survey
from shmio.segment import Block, Segment

MAX_FILES: Final = 16
"""How many recordings, the newest first, are looked into."""

log = logging.getLogger("shmio.recorder")


def places(directory: Path, segment: Segment, by: str) -> dict[str, Place]:
    """For each source the last frame and event that recorders of this kind (``by``) have of this run of the instance.

    Sources that were not recorded, or had another layout then, are left out.
    """
    found: dict[str, Place] = {}
    for file in _newest(directory, segment.instance):
        try:
            with Reader(file) as reader:
                places = _places(reader, segment.blocks)
                about = reader.about
        except (OSError, RecordingError) as error:
            log.warning("it is not known where the recording before ended: %s", error)
            continue
        if (about.get("instance"), about.get("recorder")) != (segment.instance, by):
            continue
        if about.get("epoch") != f"{segment.header.epoch:016x}":
            break
        found = places | found
        if found.keys() >= segment.blocks.keys():
            break
    return found


def _newest(directory: Path, instance: str) -> Iterator[Path]:
    """The instance's recordings; their names tell when they were begun."""
    files = sorted(directory.glob(f"{instance}-*{SUFFIX}"), reverse=True)
    yield from files[:MAX_FILES]


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
