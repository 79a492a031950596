"""The blocks of a dump: each is a source with one layout."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from shmio.errors import RecordingError
from shmio.layout.glob import named
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, find, parse_topic
from shmio.layout.values.codec import Value, codec
from shmio.recording.format.encoding import EVENT, FRAME
from shmio.recording.reading.part import Part
from shmio.recording.reading.survey import Track
from shmio.segment import Frame


@dataclass(slots=True, eq=False)
class DumpBlock:
    """A source with one layout. A reload that changes the layout starts another block.

    ``section`` is unique among the blocks of a run, also across files. ``layout_hash`` is a SHA-256 in hex.
    """

    source: str
    section: int
    layout: Layout
    layout_hash: str
    period_ns: int
    stale_ns: int
    of: str = ""
    """Hash of the whole layout, if only some of its registers were recorded."""
    frames: int = 0
    """Number of recorded frames; those in two files count twice."""
    events: int = 0
    after: dict[str, int] = field(default_factory=dict)
    """Numbers before the first recorded frame and event, by ``frames`` and ``events``."""
    begin_ns: int = 0
    end_ns: int = 0
    """Log times of the first and last frame or event."""
    first_ns: int = 0
    last_ns: int = 0
    """Log times of the first and last frame."""

    def add(self, kind: str, track: Track) -> None:
        """Add the frames or events of a file."""
        if kind == FRAME:
            self.frames += track.count
            self.first_ns = min(self.first_ns or track.first_ns, track.first_ns)
            self.last_ns = max(self.last_ns, track.last_ns)
        else:
            self.events += track.count
        self.begin_ns = min(self.begin_ns or track.first_ns, track.first_ns)
        self.end_ns = max(self.end_ns, track.last_ns)

    def register(self, path: str) -> Register:
        """Return a register or array element, by its path with or without the source; PathError."""
        return find(self.layout, parse_topic(path, (self.source,), self.source).path)

    def named(self, topic: Topic) -> list[Register]:
        """Return the registers that a topic of any form names; PathError."""
        return named(self.layout, topic)

    def value(self, frame: Frame, path: str) -> Value:
        """Return the value that consumers saw of a register in a frame of this block; PathError."""
        return codec(self.register(path), self.layout.byte_order).decode(frame.image)


@dataclass(slots=True)
class Contents:
    """Channels of one file, by number."""

    blocks: dict[int, DumpBlock] = field(default_factory=dict)
    """Of frames and events."""
    kinds: dict[int, str] = field(default_factory=dict)
    instance: set[int] = field(default_factory=set)
    """What is of no single block: gaps, steps."""
    numbered: dict[tuple[str, int], DumpBlock] = field(default_factory=dict)
    """Blocks by source and their number in this file."""
    number: dict[DumpBlock, int] = field(default_factory=dict)

    def frames(self, source: str) -> list[int]:
        """Channels with frames of a source, in the order in which the blocks began."""
        return [number for number, kind in self.kinds.items() if kind == FRAME and self.blocks[number].source == source]

    def events(self, sources: Collection[str]) -> list[int]:
        """Channels with events of these sources."""
        return [
            number for number, kind in self.kinds.items() if kind == EVENT and self.blocks[number].source in sources
        ]


def contents(part: Part, blocks: dict[tuple[str, int, str], DumpBlock]) -> Contents:
    """Return the contents of a file, and add its new blocks to ``blocks``.

    A block with a damaged layout is left out and listed in the survey's damage.
    """
    found = Contents()
    for channel in sorted(part.reader.channels.values(), key=lambda channel: (channel.block, channel.number)):
        if channel.encoding not in (FRAME, EVENT):
            if channel.encoding:
                found.instance.add(channel.number)
            continue
        key = channel.source, channel.section, channel.layout
        if key not in blocks:
            try:
                layout = part.reader.layout(channel)
            except RecordingError as error:
                if str(error) not in part.found.damage:
                    part.found.damage.append(str(error))
                continue
            blocks[key] = DumpBlock(
                channel.source,
                channel.section,
                layout,
                channel.layout,
                channel.period_ns,
                channel.stale_ns,
                channel.of,
            )
        block = blocks[key]
        block.after.setdefault("frames" if channel.encoding == FRAME else "events", channel.after)
        if track := part.found.tracks.get(channel.number):
            block.add(channel.encoding, track)
        found.blocks[channel.number] = found.numbered[channel.source, channel.block] = block
        found.kinds[channel.number] = channel.encoding
        found.number[block] = channel.block
    return found
