"""Join the numbered frames and events of several files."""

from __future__ import annotations

import msgspec

from shmio.recording.format.encoding import Gap, Reason
from shmio.recording.reading.blocks import Contents, DumpBlock
from shmio.recording.reading.reader import Item
from shmio.segment import Event, Frame


class Sequence:
    """Removes duplicates, and finds what is missing between two files."""

    def __init__(self) -> None:
        self._last: dict[tuple[DumpBlock, str], tuple[Contents, int, int]] = {}
        """File, number and log time of the last item."""

    def next(self, file: Contents, block: DumpBlock, time_ns: int, item: Item) -> tuple[Gap | None, Item | None]:
        """Return the gap before an item, or None, and the item without what came before, or None."""
        if isinstance(item, Gap):
            what, first, last = item.what, item.first, item.last
        elif isinstance(item, Frame | Event):
            what = "frames" if isinstance(item, Frame) else "events"
            first = last = item.number
        else:
            return None, item
        before = self._last.get((block, what))
        if before is not None:
            file_before, number, before_ns = before
            if last <= number:
                return None, None
            if first <= number and isinstance(item, Gap):
                first = number + 1
                item = msgspec.structs.replace(item, first=first, count=last - number)
        self._last[block, what] = file, last, time_ns
        if before is None or first == number + 1 or file_before is file:
            return None, item
        missing = first - number - 1
        place = block.source, file.number[block], what
        return Gap(*place, number + 1, first - 1, missing, Reason.ELSEWHERE, before_ns, time_ns), item
