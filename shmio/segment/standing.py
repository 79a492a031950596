"""The injections that stand on a block at present, for all to see, and for the source's next process to go on with.

The section is a cell (docs/reference/segment-format.md) that holds a JSON document of at most STANDING_SIZE bytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import msgspec

from shmio.layout.model import Register
from shmio.layout.write import bits_of
from shmio.segment import _atomics

STANDING_SIZE: Final = 16_384
CELL_SIZE: Final = 8 + STANDING_SIZE


class Standing(msgspec.Struct, frozen=True):
    """One injection. The innermost comes first.

    ``direction``: ``out`` or ``in``. ``ranges``: (offset, size, mask): these bits of these bytes of the block.
    ``writer``, ``pid``: the command queue and the process that it came from; with ``keep`` it outlives them.
    """

    id: int
    direction: str
    priority: int
    keep: bool
    name: str
    writer: int
    pid: int
    ranges: tuple[tuple[int, int, int], ...]

    def covers(self, register: Register) -> bool:
        """Whether any bit of a register is covered."""
        start, stop, own = register.offset, register.offset + register.size, bits_of(register)[0]
        return any(start < at + count and at < stop and bits & own for at, count, bits in self.ranges)


_DECODER = msgspec.json.Decoder(tuple[Standing, ...])  # as in layout/document.py: built before there are threads


def ranges_of(cover: bytes) -> tuple[tuple[int, int, int], ...]:
    """The bits that are set in an image, as ranges of bytes with the same ones."""
    ranges: list[tuple[int, int, int]] = []
    for at, bits in enumerate(cover):
        if not bits:
            continue
        if ranges and ranges[-1][2] == bits and ranges[-1][0] + ranges[-1][1] == at:
            ranges[-1] = ranges[-1][0], ranges[-1][1] + 1, bits
        else:
            ranges.append((at, 1, bits))
    return tuple(ranges)


def encode(standing: Iterable[Standing]) -> bytes:
    """The document; ValueError: it is too long."""
    document = msgspec.json.encode(tuple(standing))
    if len(document) > STANDING_SIZE:
        raise ValueError("the injections cover too many separate ranges: lay them over whole structures or arrays")
    return document


class StandingCell:
    """The section of one block."""

    def __init__(self, memory: memoryview, offset: int, size: int) -> None:
        """ValueError: the section is too short."""
        if size < CELL_SIZE:
            raise ValueError("the section of its injections is too short")
        self._memory = memory
        self._offset = offset

    def read(self) -> tuple[Standing, ...]:
        """All that stand; none where the section makes no sense."""
        data = _atomics.cell_read(self._memory, self._offset, STANDING_SIZE)
        document = (data or b"").rstrip(b"\0")
        try:
            return _DECODER.decode(document) if document else ()
        except msgspec.MsgspecError:
            return ()

    def write(self, document: bytes) -> None:
        """Say what stands; the source's process alone."""
        _atomics.cell_write(self._memory, self._offset, document.ljust(STANDING_SIZE, b"\0"))
