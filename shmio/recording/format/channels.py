"""What a recording says of its channels."""

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
    """Where the messages of one kind of one block are. ``layout``: the hash of its layout, in hexadecimal digits.

    ``encoding`` is FRAME for frames of either version, and empty for messages that are not a recorder's.
    """

    number: int
    encoding: str
    topic: str
    source: str = ""
    block: int = 0
    section: int = 0
    after: int = 0
    """Number behind which the recording of this kind began."""
    layout: str = ""
    period_ns: int = 0
    stale_ns: int = 0
    of: str = ""
    """The hash of the whole layout, where only some of its registers were recorded."""
    differences: bool = False
    """Whether its frames are as FRAME_V2 has them."""


def describe(content: memoryview) -> Channel:
    """The channel that a record describes; ValueError, KeyError, struct.error, McapError."""
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
