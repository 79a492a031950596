"""Makes the next slot of a ring half-written, and detects such a slot. Uses only the documented format."""

from __future__ import annotations

import random
import struct
from typing import Final, NamedTuple

_ENTRY: Final = 128
_RING: Final = 128
_FRAMES: Final = 2


class Slot(NamedTuple):
    """The slot after the newest frame. ``number``: number of the next frame."""

    number: int
    offset: int
    size: int


def next_slot(memory: memoryview, source: str) -> Slot:
    """Find the next slot. KeyError: the source has no ring."""
    (count,) = struct.unpack_from("<I", memory, 52)
    (table,) = struct.unpack_from("<Q", memory, 56)
    for entry in range(table, table + _ENTRY * count, _ENTRY):
        kind, retired, ring = struct.unpack_from("<IIQ", memory, entry)
        name = bytes(memory[entry + 32 : entry + 96]).rstrip(b"\0").decode()
        if (kind, retired & 1, name) == (_FRAMES, 0, source):
            slots, stride = struct.unpack_from("<II", memory, ring)
            (head,) = struct.unpack_from("<Q", memory, ring + 64)
            return Slot(head + 1, ring + _RING + stride * ((head + 1) % slots), stride)
    raise KeyError(source)


def torn(memory: memoryview, source: str) -> bool:
    """Return whether the next slot is half-written."""
    slot = next_slot(memory, source)
    sequence: int = struct.unpack_from("<Q", memory, slot.offset)[0]
    return sequence == 2 * slot.number + 1


def deface(memory: memoryview, source: str, seed: int) -> None:
    """Leave the next slot as a writer that dies while it writes: marked as begun, and half filled with random bytes."""
    slot = next_slot(memory, source)
    struct.pack_into("<Q", memory, slot.offset, 2 * slot.number + 1)
    rubbish = random.Random(seed).randbytes(slot.size // 2)
    memory[slot.offset + 8 : slot.offset + 8 + len(rubbish)] = rubbish
