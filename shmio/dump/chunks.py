"""Which chunks a recording has: where they are, from when to when, and messages of which channels are in them."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from shmio.dump.records import Record
from shmio.errors import RecordingError

MAX_CHUNKS: Final = 1 << 22
MAX_SETS: Final = 1 << 16
"""Different sets of channels that chunks hold."""

_Times = npt.NDArray[np.uint64]


class Chunks:
    """A table of chunks, and of places that cannot be read, as the file has them; 40 bytes for each."""

    def __init__(self) -> None:
        self._at = array("Q")
        self._size = array("Q")
        self._first_ns = array("Q")
        self._last_ns = array("Q")
        self._opcode = array("B")
        self._held = array("I")
        self._sets: dict[frozenset[int], int] = {}

    def __len__(self) -> int:
        return len(self._at)

    def add(self, chunk: Record, first_ns: int, last_ns: int, channels: Collection[int]) -> None:
        """The next chunk; RecordingError: more than any recorder makes."""
        held = frozenset(channels)
        if len(self._at) >= MAX_CHUNKS or (held not in self._sets and len(self._sets) >= MAX_SETS):
            raise RecordingError(f"more than {MAX_CHUNKS} chunks, or channels in more than {MAX_SETS} combinations")
        self._opcode.append(chunk.opcode)
        self._held.append(self._sets.setdefault(held, len(self._sets)))
        self._at.append(chunk.at)
        self._size.append(chunk.size)
        self._first_ns.append(first_ns)
        self._last_ns.append(last_ns)

    def add_broken(self, record: Record) -> None:
        """Bytes that make no sense, behind the last chunk; RecordingError."""
        at_ns = self._last_ns[-1] if self._last_ns else 0
        self.add(record, at_ns, at_ns, ())

    def between(
        self, from_ns: int, to_ns: int, channels: Collection[int] | None = None
    ) -> Iterator[tuple[Record, int, int]]:
        """(chunk, log time of its first message, of its last) of those that may hold something of this range.

        ``channels``: only those with messages of some of these.
        """
        begin, end = self._bounds(from_ns, to_ns)
        yield from self._rows(range(begin, end), from_ns, to_ns, channels)

    def before(self, time_ns: int, channels: Collection[int] | None = None) -> Iterator[tuple[Record, int, int]]:
        """The same of those that begin not after a time, the last one first."""
        _, end = self._bounds(0, time_ns)
        yield from self._rows(range(end - 1, -1, -1), 0, time_ns, channels)

    def _rows(
        self, indices: range, from_ns: int, to_ns: int, channels: Collection[int] | None
    ) -> Iterator[tuple[Record, int, int]]:
        wanted = {number for held, number in self._sets.items() if channels is None or not held.isdisjoint(channels)}
        for index in indices:
            first_ns, last_ns = self._first_ns[index], self._last_ns[index]
            if self._held[index] in wanted and first_ns <= to_ns and last_ns >= from_ns:
                yield Record(self._opcode[index], self._at[index], self._size[index]), first_ns, last_ns

    def _bounds(self, from_ns: int, to_ns: int) -> tuple[int, int]:
        """Indices between which all are that may hold something of this range: their times may overlap a little."""
        latest_ns, earliest_ns = self._sorted
        begin = int(np.searchsorted(latest_ns, np.uint64(min(max(from_ns, 0), _MAX_U64)), "left"))
        end = int(np.searchsorted(earliest_ns, np.uint64(min(max(to_ns, 0), _MAX_U64)), "right"))
        return begin, end

    @cached_property
    def _sorted(self) -> tuple[_Times, _Times]:
        """The latest time up to each chunk, and the earliest from each on: both go up. The table is complete then."""
        first_ns: npt.NDArray[Any] = np.array(self._first_ns, np.uint64)
        last_ns: npt.NDArray[Any] = np.array(self._last_ns, np.uint64)
        return np.maximum.accumulate(last_ns), np.minimum.accumulate(first_ns[::-1])[::-1]


_MAX_U64: Final = (1 << 64) - 1
