"""What a recording holds of one source, by position: a time of the recorded instance's clock, in ns since its start."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from shmio.dump.channels import Channel
from shmio.dump.encoding import Gap
from shmio.dump.reader import Reader
from shmio.dump.records import Record
from shmio.errors import RecordingError
from shmio.layout.model import Layout
from shmio.segment import Event, Frame

log = logging.getLogger("shmio.source")


class Hole(NamedTuple):
    """Frames that are not in the recording."""

    reason: str


class Entry(NamedTuple):
    """A frame, an event, or where frames are missing."""

    position_ns: int
    item: Frame | Event | Hole


class Chunk(NamedTuple):
    """A part of a file, and the log times of its first and its last message."""

    reader: Reader
    record: Record
    first_ns: int
    last_ns: int


class Tape:
    """One source of a recording. Several of its iterators may be under way; for one thread."""

    def __init__(
        self, source: str, layout: Layout, period_ns: int, stale_ns: int, chunks: Sequence[Chunk], utc_ns: int
    ) -> None:
        """``chunks``: in the order of time, those of the source among them. ``utc_ns``: of position 0."""
        self.source = source
        self.layout = layout
        self.period_ns = period_ns
        self.stale_ns = stale_ns
        self._digest = layout.hash.hex()  # what has another layout is of another block, which is not played
        self._chunks = chunks
        self._firsts = [chunk.first_ns for chunk in chunks]
        self._utc_ns = utc_ns

    @property
    def first_ns(self) -> int:
        """A position before which there is nothing."""
        return self._firsts[0] - self._utc_ns

    def entries(self, from_ns: int) -> Iterator[Entry]:
        """All from a position on, in the order in which it happened. What is damaged is a hole."""
        from_log_ns = from_ns + self._utc_ns
        at_ns = from_ns
        for chunk in self._chunks:
            if chunk.last_ns < from_log_ns:
                continue
            for entry in self._in(chunk, at_ns):
                if entry.position_ns >= from_ns:
                    at_ns = max(at_ns, entry.position_ns)
                    yield entry._replace(position_ns=at_ns)

    def newest(self, position_ns: int) -> Entry | None:
        """The last frame at or before a position, or the hole that it lies in; None: there is none before."""
        place = bisect_right(self._firsts, position_ns + self._utc_ns)
        for chunk in reversed(self._chunks[:place]):
            found = None
            for entry in self._in(chunk, chunk.first_ns - self._utc_ns):
                if entry.position_ns > position_ns:
                    break
                if not isinstance(entry.item, Event):
                    found = entry
            if found is not None:
                return found
        return None

    def _in(self, chunk: Chunk, at_ns: int) -> Iterator[Entry]:
        """What a chunk has of the source; ``at_ns``: the position before it."""
        reader = chunk.reader
        try:
            for channel, log_ns, data in reader.raw(chunk.record):
                if not self._ours(channel):
                    continue
                item = reader.decode(channel, data)
                if isinstance(item, Gap):
                    if item.source == self.source and item.what == "frames":
                        yield self._hole(item, at_ns)
                elif isinstance(item, Frame | Event):
                    at_ns = log_ns - self._utc_ns
                    yield Entry(at_ns, item)
        except RecordingError as error:
            log.warning("%s", error)
            yield Entry(at_ns + self.period_ns, Hole(f"not in the recording: it is damaged ({error})"))

    def _ours(self, channel: Channel) -> bool:
        return not channel.source or (channel.source == self.source and channel.layout == self._digest)

    def _hole(self, gap: Gap, at_ns: int) -> Entry:
        """It begins a period after the frame before it, or with the one behind it."""
        after_ns = gap.after_ns - self._utc_ns + self.period_ns if gap.after_ns else at_ns
        if gap.before_ns:
            after_ns = min(after_ns, gap.before_ns - self._utc_ns)
        count = f"{gap.count} frame{'s' * (gap.count != 1)}"
        return Entry(after_ns, Hole(f"not in the recording: {count} ({gap.reason})"))
