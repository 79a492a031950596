"""Descriptions of a recording's channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from mcap.records import Channel as ChannelRecord

from shmio.recording.format.encoding import (
    EVENT,
    FRAME,
    FRAME_V2,
    GAP,
    GAPS_TOPIC,
    PLAIN,
    PROCESS,
    PROCESSES_TOPIC,
    STEP,
    STEPS_TOPIC,
)
from shmio.recording.format.records import stream

MAX_CHANNELS: Final = 10_000
MAX_CHANNEL_BYTES: Final = 4096

_OWN: Final = {GAPS_TOPIC: GAP, STEPS_TOPIC: STEP, PROCESSES_TOPIC: PROCESS}


@dataclass(frozen=True, slots=True)
class Channel:
    """The channel of a block's frames or events, or of gaps, steps or processes.

    ``layout``: hash of the block's layout, in hex. ``encoding`` is FRAME for frames of either version, and
    empty for messages that no recorder wrote.
    """

    number: int
    encoding: str
    topic: str
    source: str = ""
    block: int = 0
    section: int = 0
    after: int = 0
    """Number before the first recorded frame or event."""
    layout: str = ""
    period_ns: int = 0
    stale_ns: int = 0
    of: str = ""
    """Hash of the whole layout, if only some of its registers were recorded."""
    differences: bool = False
    """Whether frames are encoded as FRAME_V2."""


def describe(content: memoryview) -> Channel:
    """Decode a channel's record. ValueError, KeyError, struct.error, McapError: it is malformed."""
    found = ChannelRecord.read(stream(content))
    about = found.metadata
    if found.message_encoding in (FRAME, FRAME_V2, EVENT):
        block, section, after = (int(about[name]) for name in ("block", "section", "after"))
        period_ns, stale_ns = (int(about[name]) for name in ("period_ns", "stale_ns"))
        source, layout = about["source"], about["layout"]
        encoding = EVENT if found.message_encoding == EVENT else FRAME
        return Channel(
            found.id, encoding, found.topic, source, block, section, after, layout, period_ns, stale_ns,
            about.get("of", ""), found.message_encoding == FRAME_V2,
        )  # fmt: skip
    if found.message_encoding == PLAIN and found.topic in _OWN:
        return Channel(found.id, _OWN[found.topic], found.topic)
    return Channel(found.id, "", found.topic)  # another program's
