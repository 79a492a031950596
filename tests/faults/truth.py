"""What an emulated PLC really had in its block, and when: the ground truth that checkers hold all values against.

The PLC numbers the states of its block (*generations*) through all its lives and writes each with its time into a file
that it maps; a checker maps it too. A word of the block names its generation and its place, so a value proves where it
comes from, and a mixed image shows itself.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np

ENTRIES: Final = 1 << 19
"""Generations that are remembered: a quarter of an hour and more."""

Words = np.ndarray[Any, np.dtype[np.uint64]]

_HEADER: Final = struct.Struct("=QQ")  # newest generation; time of death, 0 while alive
_ENTRY: Final = struct.Struct("=QQ")  # generation, time since when the block has it
_SIZE: Final = 64 + ENTRIES * _ENTRY.size
_STRIDE: Final = (
    0x9E37_79B9_7F4A_7C15  # odd, so that no two places of a block hold the same word; as in the program counter
)


def image(generation: int, places: Words) -> bytes:
    """The block of a generation: big-endian words that name it and their place."""
    return (places + np.uint64(generation)).astype(">u8").tobytes()


def places(size: int) -> Words:
    """What makes the words of a block of ``size`` bytes differ from place to place; the first is 0."""
    return np.arange(size // 8, dtype=np.uint64) * np.uint64(_STRIDE)


def generations(raw: bytes, of: Words) -> Words:
    """The generation that each word of an image claims to be of."""
    return np.frombuffer(raw, ">u8").astype(np.uint64) - of


class Truth:
    """The file, for the one who writes it and for those who read it. All times are CLOCK_MONOTONIC ns."""

    def __init__(self, file: Path, *, create: bool = False) -> None:
        if create:
            with file.open("wb") as new:
                new.truncate(_SIZE)
        with file.open("r+b") as opened:
            self._map = mmap.mmap(opened.fileno(), _SIZE)

    def record(self, generation: int, now_ns: int) -> None:
        """Tell, before the block can be read, that it has this generation from now on."""
        _ENTRY.pack_into(self._map, 64 + generation % ENTRIES * _ENTRY.size, generation, now_ns)
        _HEADER.pack_into(self._map, 0, generation, 0)

    def land(self, value: int, now_ns: int) -> None:
        """Tell that somebody wrote this value. In a file of its own: of the word that the program leaves alone."""
        _ENTRY.pack_into(self._map, 64 + value % ENTRIES * _ENTRY.size, value, now_ns)

    def bury(self, now_ns: int) -> None:
        """Tell that the PLC is dead: it has nothing any more."""
        _HEADER.pack_into(self._map, 0, self.newest, now_ns)

    @property
    def newest(self) -> int:
        """The newest generation; 0 before the first."""
        newest: int = _HEADER.unpack_from(self._map)[0]
        return newest

    def since_ns(self, generation: int) -> int | None:
        """When the PLC's block got this generation; None if it never had it, or too long ago."""
        entry: tuple[int, int] = _ENTRY.unpack_from(self._map, 64 + generation % ENTRIES * _ENTRY.size)
        return entry[1] if generation and entry[0] == generation else None

    def age_ns(self, generation: int, now_ns: int) -> int | None:
        """For how long, at ``now_ns``, the PLC has not had this generation any more; None if it never had it."""
        if self.since_ns(generation) is None:
            return None
        newest, dead_ns = _HEADER.unpack_from(self._map)
        until_ns = self.since_ns(generation + 1) if generation < newest else dead_ns or now_ns
        return max(0, now_ns - (now_ns if until_ns is None else until_ns))

    def close(self) -> None:
        """Unmap."""
        self._map.close()
