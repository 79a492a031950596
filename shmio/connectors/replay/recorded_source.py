"""One source in a recording, by position: ns since the start of the recorded instance."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import NamedTuple

from shmio.recording.dump import Dump
from shmio.recording.format.damage import Damage
from shmio.recording.format.encoding import Gap
from shmio.recording.reading.blocks import DumpBlock
from shmio.segment import Event, Frame

log = logging.getLogger("shmio.source")


class MissingFrames(NamedTuple):
    """Frames that are missing in the recording."""

    reason: str


class Entry(NamedTuple):
    """A frame, an event, or a gap, with its position."""

    position_ns: int
    item: Frame | Event | MissingFrames


class RecordedSource:
    """Reads one source of a recording. Several iterators may run at once, in one thread."""

    def __init__(self, dump: Dump, damage: list[Damage], block: DumpBlock, utc_ns: int) -> None:
        """Create the reader.

        Args:
            dump: The recording.
            damage: The list to which the dump adds damaged places.
            block: A block of the source. Only the source's blocks with the same layout are played.
            utc_ns: UTC of position 0.

        """
        self._dump = dump
        self._damage = damage
        self.block = block
        self._utc_ns = utc_ns
        self._holes = [gap for gap in dump.gaps if gap.source == block.source and gap.what == "frames"]

    def entries(self, from_ns: int | None) -> Iterator[Entry]:
        """Yield the entries from a position on (None: from the first), in their order.

        Damage and gaps are MissingFrames.
        """
        at_ns = from_ns
        begin_ns = 0 if from_ns is None else max(0, from_ns + self._utc_ns)
        for time_ns, block, item in self._dump.items(self.block.source, begin_ns):
            position_ns = time_ns - self._utc_ns
            if self._damage:
                self._damage.clear()
                yield Entry(position_ns if at_ns is None else min(at_ns + self.block.period_ns, position_ns), _DAMAGED)
            if isinstance(item, Gap):
                if item.what == "frames":
                    yield self._hole(item, position_ns)
            elif isinstance(item, Frame | Event) and self._is_played(block):
                yield Entry(position_ns, item)
            else:
                continue
            at_ns = position_ns

    def newest(self, position_ns: int) -> Entry | None:
        """Return the last frame at or before a position, or the gap there.

        None if neither exists.
        """
        found = self._dump.latest(self.block.source, position_ns + self._utc_ns)
        self._damage.clear()
        last = None
        if found is not None and self._is_played(found.block):
            last = Entry(found.time_ns - self._utc_ns, found.item)
        holes = (self._hole(gap, position_ns) for gap in self._holes)
        return max(
            (entry for entry in (last, *holes) if entry is not None and entry.position_ns <= position_ns),
            key=lambda entry: (entry.position_ns, isinstance(entry.item, Frame)),
            default=None,
        )

    def _is_played(self, block: DumpBlock | None) -> bool:
        return block is not None and block.layout_hash == self.block.layout_hash

    def _hole(self, gap: Gap, at_ns: int) -> Entry:
        """Return the entry of a gap.

        It begins a period after the last frame, or with the next one.
        """
        position_ns = gap.after_ns - self._utc_ns + self.block.period_ns if gap.after_ns else at_ns
        if gap.before_ns:
            position_ns = min(position_ns, gap.before_ns - self._utc_ns)
        count = f"{gap.count} frame{'s' * (gap.count != 1)}"
        return Entry(position_ns, MissingFrames(f"not in the recording: {count} ({gap.reason})"))


_DAMAGED = MissingFrames("not in the recording: it is damaged here")
