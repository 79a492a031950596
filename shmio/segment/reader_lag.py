"""How far each process that reads a source's frames is behind.

The block of a source has a table with an entry for each process of the instance. With each
heartbeat, a process writes its entry, which describes the slowest of its readers. Programs that do
not belong to the instance have no entry.
"""

from __future__ import annotations

import struct
import time
from typing import Final, NamedTuple

from shmio.segment import _atomics
from shmio.segment.header import MAX_PROCESSES

_ENTRY: Final = struct.Struct("<IIQQQ")
_STRIDE: Final = 64
"""Size of an entry in bytes: a cache line, so that no two processes write to the same one."""
TABLE_SIZE: Final = MAX_PROCESSES * _STRIDE
SILENT_NS: Final = 1_000_000_000
"""After this time in ns without a report, a process counts as hung, and its lag grows."""


class ReaderLag(NamedTuple):
    """How far a process's slowest reader of a source is behind.

    Attributes:
        frames: Number of complete frames that the reader has not read.
        behind_ns: Time in ns since the oldest of these frames was published; 0 if there is none.
    """

    frames: int
    behind_ns: int


class ReportedPosition(NamedTuple):
    """What a process reports about its slowest reader of a source. Times are in ns.

    Attributes:
        pid: Pid of the process; 0: the process does not read the source.
        frames: Number of frames that the reader had not read at the report.
        last: Number of the last frame that the reader had read.
        behind_ns: Time from the publication of the first unread frame to the report.
        at_ns: CLOCK_MONOTONIC at the report.
    """

    pid: int
    frames: int
    last: int
    behind_ns: int
    at_ns: int


class ReaderTable:
    """The entries of all processes for one source, by the index of their slots."""

    def __init__(self, memory: memoryview, offset: int, size: int) -> None:
        if size != TABLE_SIZE:
            raise ValueError(f"its table of readers has {size} bytes, not {TABLE_SIZE}")
        self._memory, self._offset = memory, offset

    def write(self, slot: int, position: ReportedPosition) -> None:
        """Write a process's entry. Only that process may call this."""
        frames = min(position.frames, (1 << 32) - 1)
        _atomics.cell_write(self._memory, self._offset + slot * _STRIDE, _ENTRY.pack(*position._replace(frames=frames)))

    def read(self, slot: int, pid: int, head: int) -> ReaderLag | None:
        """Return how far a process is behind; None if it does not read the source.

        Args:
            slot: Index of the process's slot.
            pid: Pid of the process that has the slot now. An entry of an earlier process does not
                count.
            head: Number of the source's newest frame.

        """
        data = _atomics.cell_read(self._memory, self._offset + slot * _STRIDE, _ENTRY.size)
        if data is None:
            return None
        found = ReportedPosition(*_ENTRY.unpack(data))
        if not pid or found.pid != pid:
            return None
        silent_ns = time.monotonic_ns() - found.at_ns
        if silent_ns <= SILENT_NS:
            return ReaderLag(found.frames, found.behind_ns)
        frames = max(0, head - found.last)
        return ReaderLag(frames, found.behind_ns + silent_ns if frames else 0)
