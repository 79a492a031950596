"""Turns the messages of a source into the entries of a recording, with a gap for all that is missing."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from itertools import pairwise
from statistics import median
from typing import Final

from shmio.errors import RecordingError
from shmio.fabric.messages import Entry as FabricEntry
from shmio.fabric.messages import Header, decode_entries, decode_header
from shmio.fabric.registry import SourceEntry
from shmio.layout.model import Layout
from shmio.recording.format.encoding import Gap, Reason
from shmio.recording.reading.part import MAX_NS, DumpBlock, Entry
from shmio.recording.reading.reader import Item
from shmio.segment import Event, Frame

MAX_BLOCKS: Final = 1000
"""Maximum number of blocks of a source: a span with more reloads and restarts is not from an uplink."""
_PERIOD_NS: Final = 20_000_000
_STALE_NS: Final = 500_000_000

log = logging.getLogger("shmio.fabric")


def log_time(header: Header, entry: Frame | Event) -> int:
    """Return the log time of an entry, as recordings of the owner have it: UTC, in ns since 1970."""
    return min(max(0, entry.publish_ns + header.zero_ns), MAX_NS)


class SourceEntries:
    """Decodes the messages of one source, in the order in which they were made."""

    def __init__(
        self, source: str, layouts: Mapping[bytes, Layout], known: SourceEntry | None, sections: Iterator[int]
    ) -> None:
        """Begin.

        Args:
            source: Name of the source.
            layouts: All layouts of the messages, by the first 8 bytes of their hashes.
            known: What the registry says of the source now; None if it no longer has it.
            sections: Numbers for blocks, unique within the recording.

        """
        self.source = source
        self._layouts = layouts
        self._known = known
        self._sections = sections
        self._header: Header | None = None
        """The header of the last intact message."""
        self._damaged = False
        self._blocks = 0
        self._block: DumpBlock | None = None
        self._last: dict[str, int] = {}
        self._last_ns = 0

    def of(self, data: bytes) -> Iterator[Entry[Item]]:
        """Yield the entries of the next message, and gaps for those that are missing before them.

        Raises:
            RecordingError: The messages contradict each other.

        """
        header = decode_header(data)
        layout = self._layouts[header.layout]
        try:
            entries = list(decode_entries(data))
            if any(isinstance(entry, Frame) and len(entry.raw) != layout.size for entry in entries):
                raise ValueError("the size of a frame does not match its layout")
        except ValueError as error:
            log.warning("message %d of %s is malformed, and left out: %s", header.number, self.source, error)
            self._damaged = True
            return
        reason = self._reason(header)
        for entry in entries:
            self._choose_block(header, layout, entry, entries)
            yield from self._entries(header, entry, reason)
            self._header = header
        self._damaged = False

    def _reason(self, header: Header) -> Reason:
        """Return why entries before the first one of a message are missing."""
        before = self._header
        if self._damaged:
            return Reason.DAMAGED
        if before is None or before.stream != header.stream:
            return Reason.NOT_RUNNING
        return Reason.LEFT_OUT if header.number == before.number + 1 else Reason.NO_ROOM

    def _choose_block(self, header: Header, layout: Layout, entry: FabricEntry, entries: list[FabricEntry]) -> None:
        """Begin another block if the layout changes, or if numbers begin again: after a restart or a reload."""
        what, first = (entry.what, entry.first) if isinstance(entry, Gap) else (_what(entry), entry.number)
        before = self._header
        same = before is not None and (before.layout, before.zero_ns) == (header.layout, header.zero_ns)
        if self._block is not None and same and first > self._last.get(what, 0):
            return
        self._blocks += 1
        if self._blocks > MAX_BLOCKS:
            raise RecordingError(
                f"{self.source}: the history has more than {MAX_BLOCKS} restarts; choose a shorter time"
            )
        period_ns, stale_ns = self._rate(entries)
        digest = layout.hash.hex()
        self._block = DumpBlock(self.source, next(self._sections), layout, digest, period_ns, stale_ns)
        self._last = {}

    def _rate(self, entries: list[FabricEntry]) -> tuple[int, int]:
        """Return the source's period and the age at which its frames are stale, in ns."""
        if self._known is not None:
            return self._known.period_ns, self._known.stale_ns
        frames = [entry for entry in entries if isinstance(entry, Frame)]
        periods = [
            (two.publish_ns - one.publish_ns) // (two.cycle - one.cycle)
            for one, two in pairwise(frames)
            if two.cycle > one.cycle and two.publish_ns > one.publish_ns
        ]
        period_ns = round(median(periods)) if periods else _PERIOD_NS
        return max(1, period_ns), max(_STALE_NS, 3 * period_ns)

    def _entries(self, header: Header, entry: FabricEntry, reason: Reason) -> Iterator[Entry[Item]]:
        if isinstance(entry, Gap):
            if (last := self._last.get(entry.what)) is not None and entry.first > last + 1:
                yield self._gap(entry.what, last + 1, entry.first - 1, reason)
            yield self._gap(entry.what, entry.first, entry.last, entry.reason)
            self._last[entry.what] = entry.last
            return
        what = _what(entry)
        if isinstance(entry, Frame):
            self._last.setdefault("events", entry.event)
        else:
            self._last.setdefault("frames", entry.frame)
        before_ns, self._last_ns = self._last_ns, max(self._last_ns, log_time(header, entry))
        if (last := self._last.get(what)) is not None and entry.number > last + 1:
            yield self._gap(what, last + 1, entry.number - 1, reason, before_ns)
        self._last[what] = entry.number
        yield Entry(self._last_ns, self._block, entry)

    def _gap(self, what: str, first: int, last: int, reason: Reason, after_ns: int | None = None) -> Entry[Item]:
        after_ns = self._last_ns if after_ns is None else after_ns
        gap = Gap(self.source, self._blocks, what, first, last, last - first + 1, reason, after_ns, self._last_ns)
        return Entry(self._last_ns, self._block, gap)


def _what(entry: Frame | Event) -> str:
    return "frames" if isinstance(entry, Frame) else "events"
