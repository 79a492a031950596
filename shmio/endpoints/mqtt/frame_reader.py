"""The frames of one block for who tells a broker of them: in order, a few at a time, and never far behind."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from shmio.segment import Block, Frame

MAX_FRAMES_PER_TURN: Final = 8
"""So many are taken before what else there is to do has its turn."""
CATCH_UP_S: Final = 3.0
"""Who is further behind than this, or than half of the ring, goes on with the newest frame; skips are counted."""


class FrameReader:
    """Begins with the newest one that there is. For one thread."""

    def __init__(self, block: Block) -> None:
        self._block = block
        self.missed = 0
        """Frames that were skipped, or overwritten before they were read."""
        self._most = max(1, min(round(CATCH_UP_S * 1e9 / block.period_ns), block.ring.slot_count // 2))
        newest = block.latest()
        self._cursor = block.cursor(after=newest.number - 1 if newest else 0)

    @property
    def behind(self) -> int:
        """How many wait."""
        return self._cursor.behind

    def read(self) -> Iterator[Frame]:
        """Those that have come; at most a few."""
        if self._cursor.behind > self._most:
            newest = self._block.ring.head()
            self.missed += newest - 1 - self._cursor.last
            self.resume_after(newest - 1)
        for _ in range(MAX_FRAMES_PER_TURN):
            before = self._cursor.missed
            frame = self._cursor.poll()
            self.missed += self._cursor.missed - before
            if frame is None:
                return
            yield frame

    def resume_after(self, number: int) -> None:
        """The next one is the one behind this."""
        self._cursor = self._block.cursor(after=number)
