"""Reads the frames of one block in order, and skips to the newest one when too far behind."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from shmio.segment import Block, Frame

MAX_FRAMES_PER_TURN: Final = 8
"""Frames that are read before other work has its turn."""
CATCH_UP_S: Final = 3.0
"""A reader that is further behind than this, or than half the ring, skips to the newest frame."""


class FrameReader:
    """Reads a block's frames, from the newest one on. Use it from one thread."""

    def __init__(self, block: Block) -> None:
        self._block = block
        self.missed = 0
        """Number of frames that were skipped, or overwritten before they were read."""
        self._most = max(1, min(round(CATCH_UP_S * 1e9 / block.period_ns), block.ring.slot_count // 2))
        newest = block.latest()
        self._cursor = block.cursor(after=newest.number - 1 if newest else 0)

    @property
    def behind(self) -> int:
        """Number of frames that have not been read."""
        return self._cursor.behind

    def read(self) -> Iterator[Frame]:
        """Yield new frames, at most ``MAX_FRAMES_PER_TURN``."""
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
        """Continue with the frame after this number."""
        self._cursor = self._block.cursor(after=number)
