"""The next slot of a ring, by the page on the segment format alone: whether it is torn, and tearing it."""

from __future__ import annotations

import random
import struct
from typing import Final, NamedTuple

_ENTRY: Final = 128
_RING: Final = 128
_FRAMES: Final = 2


class Slot(NamedTuple):
    """Where the slot after the newest frame is, and the number of the frame to come."""

    number: int
    offset: int
    size: int


def next_slot(memory: memoryview, source: str) -> Slot:
    """Find it; KeyError when there is no ring of this source."""
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
    """Whether the slot after the newest frame was begun and not finished."""
    slot = next_slot(memory, source)
    sequence: int = struct.unpack_from("<Q", memory, slot.offset)[0]
    return sequence == 2 * slot.number + 1


def deface(memory: memoryview, source: str, seed: int) -> None:
    """Leave the next slot as a writer does that dies in the middle of it: begun, half of it rubbish."""
    slot = next_slot(memory, source)
    struct.pack_into("<Q", memory, slot.offset, 2 * slot.number + 1)
    rubbish = random.Random(seed).randbytes(slot.size // 2)
    memory[slot.offset + 8 : slot.offset + 8 + len(rubbish)] = rubbish
