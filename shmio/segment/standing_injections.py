"""The injections that stand on a block at present, for all to see, and for the source's next process to go on with.

Beside them those that the configuration declares, which the supervisor writes. Both sections are cells
(docs/reference/segment-format.md) that hold a JSON document of at most STANDING_SIZE bytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Generic, TypeVar

import msgspec

from shmio.config import Declaration
from shmio.layout.model import Register
from shmio.layout.values.write import bits_of
from shmio.segment import _atomics
from shmio.segment.events import NO_WRITER

STANDING_SIZE: Final = 32_768
CELL_SIZE: Final = 8 + STANDING_SIZE


class DeclaredState(msgspec.Struct, frozen=True):
    """How a declared injection is. ``state``: ``waiting``, ``active``, ``over``, or ``lifted`` before its time.

    ``seed``: from which all that is random in it follows, drawn by the source where the declaration has none.
    ``runs``: how often it has become active, the last time at ``cycle``, when the instance's clock was ``time_ns``.
    """

    declaration: Declaration
    state: str
    seed: int
    runs: int = 0
    cycle: int = 0
    time_ns: int = 0


class StandingInjection(msgspec.Struct, frozen=True, omit_defaults=True):
    """One injection. The innermost comes first.

    ``direction``: ``out`` or ``in``. ``ranges``: (offset, size, mask): these bits of these bytes of the block.
    ``writer``, ``pid``: the command queue and the process that it came from; with ``keep`` it outlives them. NO_WRITER
    and 0: the configuration. ``running``: of one that was declared; else its client gives it values.
    """

    id: int
    direction: str
    priority: int
    keep: bool
    name: str
    writer: int
    pid: int
    ranges: tuple[tuple[int, int, int], ...]
    running: DeclaredState | None = None

    @property
    def configured(self) -> bool:
        """Whether it is declared in the configuration."""
        return self.running is not None and self.writer == NO_WRITER

    @property
    def active(self) -> bool:
        """Whether it changes what it covers at present."""
        return self.running is None or self.running.state == "active"

    @property
    def lifted(self) -> bool:
        """Whether it is there in name only, for the configuration still has it."""
        return self.running is not None and self.running.state == "lifted"

    def covers(self, register: Register) -> bool:
        """Whether it changes any bit of a register at present."""
        return self.active and self.reaches(register)

    def reaches(self, register: Register) -> bool:
        """Whether it stands over any bit of a register."""
        start, stop = register.offset, register.offset + register.size
        own = bits_of(register)
        shared = (
            (own[max(at - start, 0) : min(at + count, stop) - start], bits) for at, count, bits in self.ranges
            if start < at + count and at < stop
        )  # fmt: skip
        return any(bits & mine for part, bits in shared for mine in (part if register.partial else part[:1]))


# As in layout/document.py: built before there are threads.
_STANDING = msgspec.json.Decoder(tuple[StandingInjection, ...])
_DECLARED = msgspec.json.Decoder(tuple[Declaration, ...])
_Item = TypeVar("_Item")


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


def encode(items: Iterable[bytes], growth: int = 0) -> bytes:
    """The document of items that are JSON each; ValueError: it is too long, or would be with ``growth`` bytes more."""
    document = b"[" + b",".join(items) + b"]"
    if len(document) + growth > STANDING_SIZE:
        raise ValueError("too much for the injections of one source: lay fewer, over whole structures or arrays")
    return document


class DocumentCell(Generic[_Item]):
    """A section of one block that holds a list of items; one process writes it."""

    def __init__(self, memory: memoryview, offset: int, size: int, decoder: msgspec.json.Decoder[tuple[_Item, ...]]):
        """ValueError: the section is too short."""
        if size < CELL_SIZE:
            raise ValueError("the section of its injections is too short")
        self._memory = memory
        self._offset = offset
        self._decoder = decoder

    @property
    def sequence(self) -> int:
        """Changes with each :meth:`write`."""
        return _atomics.load64(self._memory, self._offset)

    def read(self) -> tuple[_Item, ...]:
        """All items; none where the section makes no sense."""
        data = _atomics.cell_read(self._memory, self._offset, STANDING_SIZE)
        document = (data or b"").rstrip(b"\0")
        try:
            return self._decoder.decode(document) if document else ()
        except msgspec.MsgspecError:
            return ()

    def write(self, document: bytes) -> None:
        """Write a document of :func:`encode`."""
        _atomics.cell_write(self._memory, self._offset, document.ljust(STANDING_SIZE, b"\0"))


StandingCell = DocumentCell[StandingInjection]
DeclaredCell = DocumentCell[Declaration]


def standing_cell(memory: memoryview, offset: int, size: int) -> StandingCell:
    """What stands, written by the source's process; ValueError."""
    return DocumentCell(memory, offset, size, _STANDING)


def declared_cell(memory: memoryview, offset: int, size: int) -> DeclaredCell:
    """What the configuration declares, written by the supervisor; ValueError."""
    return DocumentCell(memory, offset, size, _DECLARED)


def declared_document(declarations: Iterable[Declaration]) -> bytes:
    """What a supervisor writes; ValueError: it is too long."""
    return encode(msgspec.json.encode(declaration) for declaration in declarations)
