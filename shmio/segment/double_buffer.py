"""A value stored twice, so that one copy is intact even if its writer was killed."""

from __future__ import annotations

from typing import Final

from shmio.errors import SegmentError
from shmio.segment import _atomics

_ATTEMPTS: Final = 4


class DoubleBuffer:
    """A value in shared memory, stored in two copies (docs/reference/segment-format.md).

    Several threads may read it.
    """

    def __init__(self, memory: memoryview, copies: tuple[int, int], complaint: str) -> None:
        """``copies``: offsets of the copies. ``complaint``: message of the error if both are corrupt."""
        self._memory = memory
        self._copies = copies
        self._complaint = complaint

    def read(self, size: int) -> bytes:
        """Return the first ``size`` bytes. SegmentError: both copies are corrupt."""
        for at in self._copies * _ATTEMPTS:
            data = _atomics.cell_read(self._memory, at, size)
            if data is not None:
                return data
        raise SegmentError(self._complaint)

    def write(self, data: bytes) -> None:
        """Write one copy, then the other. Only the owner may."""
        for at in self._copies:
            _atomics.cell_write(self._memory, at, data)
