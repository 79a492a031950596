"""Lists of a block's injections: the existing injections, and those that the configuration declares.

Each list is a section of the block: a cell (docs/reference/segment-format.md) with a JSON document
of at most LIST_SIZE bytes. The source writes the list of existing injections. Every process can read
it; after a restart, the source continues the injections in it. The supervisor writes the list of
configured injections.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import Generic, TypeVar

import msgspec

from shmio.config import Declaration
from shmio.layout.model import Register
from shmio.layout.values.write import bits_of
from shmio.model.injection import Injection
from shmio.model.values import NO_WRITER
from shmio.segment import _atomics
from shmio.segment.header import LIST_SIZE


class InjectionEntry(Injection[Declaration], frozen=True, omit_defaults=True):
    """An existing injection of a source. In a block's list, the innermost injection comes first."""

    @property
    def configured(self) -> bool:
        """True if the configuration declares the injection."""
        return self.running is not None and self.writer == NO_WRITER

    @property
    def active(self) -> bool:
        """True if the injection is in effect."""
        return self.running is None or self.running.state == "active"

    @property
    def lifted(self) -> bool:
        """True if the injection was lifted but is still in the list.

        Only an injection that the configuration declares stays in the list.
        """
        return self.running is not None and self.running.state == "lifted"

    def covers(self, register: Register) -> bool:
        """Return whether the injection is in effect, and covers any bit of a register."""
        return self.active and self.reaches(register)

    def reaches(self, register: Register) -> bool:
        """Return whether the injection covers any bit of a register, even while it is not in effect."""
        start, stop = register.offset, register.offset + register.size
        own = bits_of(register)
        shared = (
            (own[max(at - start, 0) : min(at + count, stop) - start], bits) for at, count, bits in self.ranges
            if start < at + count and at < stop
        )  # fmt: skip
        return any(bits & mine for part, bits in shared for mine in (part if register.partial else part[:1]))


# Created before there are threads, as in layout/document.py.
_ENTRIES = msgspec.json.Decoder(tuple[InjectionEntry, ...])
_DECLARED = msgspec.json.Decoder(tuple[Declaration, ...])
_Item = TypeVar("_Item")


def ranges_of(cover: bytes) -> tuple[tuple[int, int, int], ...]:
    """Return the set bits of an image as ranges (offset, size, mask): one for each run of equal bytes except 0."""
    ranges, at = list[tuple[int, int, int]](), 0
    for bits, run in groupby(cover):
        size = len(bytes(run))
        if bits:
            ranges.append((at, size, bits))
        at += size
    return tuple(ranges)


def encode(items: Iterable[bytes], growth: int = 0) -> bytes:
    """Join JSON items to a document.

    Args:
        items: The items, each encoded as JSON.
        growth: Number of bytes by which the document must be able to grow later.

    Raises:
        ValueError: The document, with ``growth`` more bytes, would be too long.
    """
    document = b"[" + b",".join(items) + b"]"
    if len(document) + growth > LIST_SIZE:
        raise ValueError(
            "the injections of one source are too large; create fewer, or cover whole structures or arrays"
        )
    return document


class ListCell(Generic[_Item]):
    """A section of a block that holds a list of items. Only one process writes it."""

    def __init__(self, memory: memoryview, offset: int, decoder: msgspec.json.Decoder[tuple[_Item, ...]]) -> None:
        self._memory = memory
        self._offset = offset
        self._decoder = decoder

    @property
    def sequence(self) -> int:
        """Sequence number of the cell; each :meth:`write` changes it."""
        return _atomics.load64(self._memory, self._offset)

    def read(self) -> tuple[_Item, ...]:
        """Read all items. Return an empty tuple if the section is being written or corrupt."""
        return self.try_read() or ()

    def try_read(self) -> tuple[_Item, ...] | None:
        """Read all items. Return None if the section is being written or corrupt."""
        data = _atomics.cell_read(self._memory, self._offset, LIST_SIZE)
        if data is None:
            return None
        document = data[: data.find(0)] if data.endswith(b"\0") else data
        try:
            return self._decoder.decode(document) if document else ()
        except msgspec.MsgspecError:
            return None

    def write(self, document: bytes) -> None:
        """Write a document made by :func:`encode`."""
        _atomics.cell_write(self._memory, self._offset, document.ljust(LIST_SIZE, b"\0"))


InjectionListCell = ListCell[InjectionEntry]
DeclaredCell = ListCell[Declaration]


def injection_list_cell(memory: memoryview, offset: int) -> InjectionListCell:
    """Open the section of existing injections, which the source writes."""
    return ListCell(memory, offset, _ENTRIES)


def declared_cell(memory: memoryview, offset: int) -> DeclaredCell:
    """Open the section of configured injections, which the supervisor writes."""
    return ListCell(memory, offset, _DECLARED)


def declared_document(declarations: Iterable[Declaration]) -> bytes:
    """Encode the injections that the configuration declares as a document.

    Raises:
        ValueError: The document is too long.
    """
    return encode(msgspec.json.encode(declaration) for declaration in declarations)
