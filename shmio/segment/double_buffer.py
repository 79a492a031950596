"""A cell that is there twice: whenever its writer was killed, one is whole (docs/reference/segment-format.md)."""

from __future__ import annotations

from typing import Final

from shmio.errors import SegmentError
from shmio.segment import _atomics

_ATTEMPTS: Final = 4


class DoubleBuffer:
    """Both of its copies; several threads may read it."""

    def __init__(self, memory: memoryview, copies: tuple[int, int], complaint: str) -> None:
        """``copies``: where they begin. ``complaint``: what it means when none is whole, and what to do about it."""
        self._memory = memory
        self._copies = copies
        self._complaint = complaint

    def read(self, size: int) -> bytes:
        """Its first bytes. SegmentError: no copy of it is whole, which no writer of ours brings about."""
        for at in self._copies * _ATTEMPTS:
            data = _atomics.cell_read(self._memory, at, size)
            if data is not None:
                return data
        raise SegmentError(self._complaint)

    def write(self, data: bytes) -> None:
        """Write one, then the other; its writer alone."""
        for at in self._copies:
            _atomics.cell_write(self._memory, at, data)
