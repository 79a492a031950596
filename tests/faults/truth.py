"""The truth: what an emulated PLC really had in its block, and when.

The PLC numbers the states of its block (*generations*), also across restarts, and writes each with
its time into a file. PLC and checkers map this file. Each word of the block encodes its generation
and its place, so a value proves where it comes from, and an image of several generations is
detected.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np

ENTRIES: Final = 1 << 19
"""Number of generations in the file: those of a quarter of an hour or more."""

Words = np.ndarray[Any, np.dtype[np.uint64]]

_HEADER: Final = struct.Struct("=QQ")  # newest generation; time of death, or 0 while the PLC is alive
_ENTRY: Final = struct.Struct("=QQ")  # generation, time at which the block got it
_SIZE: Final = 64 + ENTRIES * _ENTRY.size
_STRIDE: Final = (
    0x9E37_79B9_7F4A_7C15  # odd, so that no two places of a block hold the same word; as in the program counter
)


def image(generation: int, places: Words) -> bytes:
    """Return the block of a generation: big-endian words that encode it and their places."""
    return (places + np.uint64(generation)).astype(">u8").tobytes()


def places(size: int) -> Words:
    """Return the offsets that encode the places of a block's words; the first is 0."""
    return np.arange(size // 8, dtype=np.uint64) * np.uint64(_STRIDE)


def generations(raw: bytes, of: Words) -> Words:
    """Return the generation that each word of an image encodes."""
    return np.frombuffer(raw, ">u8").astype(np.uint64) - of


class Truth:
    """The file of a truth, for its writer and its readers. All times are CLOCK_MONOTONIC in ns."""

    def __init__(self, file: Path, *, create: bool = False) -> None:
        if create:
            with file.open("wb") as new:
                new.truncate(_SIZE)
        with file.open("r+b") as opened:
            self._map = mmap.mmap(opened.fileno(), _SIZE)

    def record(self, generation: int, now_ns: int) -> None:
        """Record that the block has this generation from now on, before it can be read."""
        _ENTRY.pack_into(self._map, 64 + generation % ENTRIES * _ENTRY.size, generation, now_ns)
        _HEADER.pack_into(self._map, 0, generation, 0)

    def land(self, value: int, now_ns: int) -> None:
        """Record that this value was written into a word that the PLC's program does not write."""
        _ENTRY.pack_into(self._map, 64 + value % ENTRIES * _ENTRY.size, value, now_ns)

    def bury(self, now_ns: int) -> None:
        """Record that the PLC is dead, so that it has no values any more."""
        _HEADER.pack_into(self._map, 0, self.newest, now_ns)

    @property
    def newest(self) -> int:
        """Number of the newest generation; 0: there is none."""
        newest: int = _HEADER.unpack_from(self._map)[0]
        return newest

    def since_ns(self, generation: int) -> int | None:
        """Return when the PLC's block got this generation; None if never, or too long ago."""
        entry: tuple[int, int] = _ENTRY.unpack_from(self._map, 64 + generation % ENTRIES * _ENTRY.size)
        return entry[1] if generation and entry[0] == generation else None

    def age_ns(self, generation: int, now_ns: int) -> int | None:
        """Return the time since the PLC lost this generation; None if it never had it."""
        if self.since_ns(generation) is None:
            return None
        newest, dead_ns = _HEADER.unpack_from(self._map)
        until_ns = self.since_ns(generation + 1) if generation < newest else dead_ns or now_ns
        return max(0, now_ns - (now_ns if until_ns is None else until_ns))

    def close(self) -> None:
        """Unmap the file."""
        self._map.close()
