"""A program that makes every cycle, and every place in the block, recognisable: for tests and benchmarks."""

from __future__ import annotations

import numpy as np

from shmio.layout.model import Layout

# Odd, so that word i of generation g, g + i * STRIDE modulo 2**64, repeats neither along the block nor, within
# any time a test runs, at the same place.
_STRIDE = 0x9E37_79B9_7F4A_7C15


class Counter:
    """Fills the block with big-endian 64-bit words: the generation (cycles since start), then mixed with the place.

    A rest of less than eight bytes holds the first bytes of its word and is checked too.
    """

    period_ms = 1

    def __init__(self, layout: Layout) -> None:
        self._size = layout.size
        self._places = _places(layout.size)

    def step(self, time_s: float, frame: bytearray) -> None:
        """Write the generation of this time."""
        generation = np.uint64(round(time_s * 1000 / self.period_ms))
        frame[:] = (self._places + generation).astype(">u8").tobytes()[: self._size]


def generations(frame: bytes | bytearray | memoryview) -> list[int]:
    """List the distinct generations in a frame that a ``Counter`` wrote, ascending: one if it is of one cycle.

    A byte that no cycle put there shows as a generation far from the others.
    """
    size = len(frame)
    whole = size // 8 * 8
    places = _places(size)
    words = np.frombuffer(frame, ">u8", count=whole // 8).astype(np.uint64) - places[: whole // 8]
    found = {int(word) for word in np.unique(words)}
    rest = bytes(frame[whole:])
    if rest and not any(_word(g, whole // 8)[: len(rest)] == rest for g in found):
        found.add(int.from_bytes(rest.ljust(8, b"\0"), "big"))
    return sorted(found)


def _places(size: int) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    return np.arange((size + 7) // 8, dtype=np.uint64) * np.uint64(_STRIDE)


def _word(generation: int, place: int) -> bytes:
    return ((generation + place * _STRIDE) & 0xFFFF_FFFF_FFFF_FFFF).to_bytes(8, "big")
