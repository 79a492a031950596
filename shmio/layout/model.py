"""What a compiled layout is: a block, its registers, and where each of them lies.

Everything here is immutable and free of I/O. ``Layout`` is what the segment, the recordings and
``shmio-layout --json`` hold; the JSON form is in ``document.py``.
"""

from __future__ import annotations

import hashlib
import math
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from shmio.errors import PathError
from shmio.layout.types import ElementType, element_type

ByteOrder = Literal["big", "little"]
Dims = tuple[tuple[int, int], ...]

MAX_DIMENSIONS = 6
MAX_DEPTH = 32  # nested structures; Siemens allows 8
MAX_STANDARD_BYTES = 65_536  # what an S7-1500 allows a block with standard access
MAX_BLOCK_BYTES = 1 << 20  # any block: optimized ones, and those of other sources
MAX_REGISTERS = 100_000
MAX_ELEMENTS = 1 << 20  # of all registers together
MAX_STRUCTURES = 200_000  # of a block; they count even when they hold no register


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One thing a layout source has wrong; ``str()`` is ``file:line:col: severity: message``."""

    file: str
    line: int
    column: int
    message: str
    severity: Literal["error", "warning"] = "error"

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}: {self.severity}: {self.message}"


@dataclass(frozen=True, slots=True)
class Register:
    """A named, typed value at a fixed place in a block.

    ``path``: member names, percent-encoded, joined by ``/``; no source and no direction.
    ``type``: S7 name of the element, upper case, ``STRING[20]`` for lengths.
    ``dims``: (low, high) of each dimension; ``()`` for a scalar.
    ``offset``: first byte in the block. ``bit``: 0-7 for BOOL, else None.
    ``size``: bytes from the first to the last that holds data, without trailing padding. ``count``: elements.
    ``initial``: the source's text of the initial value.
    ``partial``: a slice of a row of bits, which begins at ``bit``; others' bits may be in its first and last byte.
    """

    path: str
    type: str
    dims: Dims
    offset: int
    bit: int | None
    size: int
    count: int
    comment: str = ""
    initial: str | None = None
    partial: bool = False

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of elements in each dimension."""
        return tuple(high - low + 1 for low, high in self.dims)

    @property
    def element(self) -> ElementType:
        """The elementary type; raises KeyError for a name that is none (a validated layout has none)."""
        found = element_type(self.type)
        if found is None:
            raise KeyError(self.type)
        return found


@dataclass(frozen=True)
class Layout:
    """A block's registers in address order. ``size`` is in bytes."""

    name: str
    number: int | None
    size: int
    optimized: bool
    registers: tuple[Register, ...]
    byte_order: ByteOrder = "big"

    @cached_property
    def by_path(self) -> Mapping[str, int]:
        """Index into ``registers`` of each path."""
        return {register.path: index for index, register in enumerate(self.registers)}

    @cached_property
    def hash(self) -> bytes:
        """SHA-256 of the canonical JSON: equal for equal layouts."""
        return hashlib.sha256(self.to_json()).digest()

    # Structures are ranges of sorted paths: a table of all structures' paths could be far larger than the layout.
    @cached_property
    def _sorted(self) -> _Sorted:
        return _Sorted(register.path for register in self.registers)

    @cached_property
    def _sorted_in_lower_case(self) -> _Sorted:
        return _Sorted(register.path.lower() for register in self.registers)

    def members(self, prefix: str) -> tuple[int, ...]:
        """Return the indices of the registers below a struct or an array of structs, ``()`` if none."""
        return self._sorted.below(prefix)

    def in_any_case(self, path: str) -> str | None:
        """Return the path of a register or structure that is this one in some case, None if there is none."""
        wanted = path.lower()
        at = self._sorted_in_lower_case.first(wanted)
        if at is None:
            return None
        return "/".join(self.registers[at].path.split("/")[: wanted.count("/") + 1])

    def element(self, register: Register, index: tuple[int, ...]) -> Register:
        """Return one element of an array register as a scalar register, its path ending in the index.

        Raises PathError: the index has not as many dimensions as the array, or is outside its bounds.
        """
        if len(index) != len(register.dims) or not all(
            low <= i <= high for i, (low, high) in zip(index, register.dims, strict=True)
        ):
            if not register.dims:
                raise PathError(f"{register.path}: a single {register.type}, not an array")
            bounds = ",".join(f"{low}..{high}" for low, high in register.dims)
            raise PathError(f"{register.path}: index {list(index)} is outside [{bounds}]")
        if not index:
            return register
        flat = 0
        for i, (low, high) in zip(index, register.dims, strict=True):
            flat = flat * (high - low + 1) + i - low
        byte, bit = element_position(register.element, register.shape, flat)
        return Register(
            path=f"{register.path}/{'/'.join(map(str, index))}",
            type=register.type,
            dims=(),
            offset=register.offset + byte,
            bit=bit,
            size=register.element.size,
            count=1,
            comment=register.comment,
        )

    def to_json(self) -> bytes:
        """Return the canonical JSON, UTF-8: the object of ``shmio-layout --json`` and ``byte_order``."""
        from shmio.layout.document import dump  # noqa: PLC0415  (document imports this module)

        return dump(self)

    @classmethod
    def from_json(cls, data: bytes) -> Layout:
        """Read what ``to_json`` wrote, from a source that may be hostile.

        Raises LayoutError: not such JSON, or a layout that cannot be: overlaps, wrong sizes, out of bounds.
        """
        from shmio.layout.document import load  # noqa: PLC0415

        return load(data)


class _Sorted:
    """Paths in order, with their places in the layout: all below a structure stand together."""

    def __init__(self, paths: Iterable[str]) -> None:
        ordered = sorted((path, index) for index, path in enumerate(paths))
        self._paths = [path for path, _ in ordered]
        self._indices = [index for _, index in ordered]

    def below(self, prefix: str) -> tuple[int, ...]:
        """The indices of the paths below the prefix, ascending."""
        start = bisect_left(self._paths, f"{prefix}/")
        stop = bisect_left(self._paths, f"{prefix}0", start)  # "0" follows "/" in Unicode
        return tuple(sorted(self._indices[start:stop]))

    def first(self, path: str) -> int | None:
        """The index of the path, or else of the first one below it."""
        for at in (bisect_left(self._paths, path), bisect_left(self._paths, f"{path}/")):
            if at < len(self._paths) and f"{self._paths[at]}/".startswith(f"{path}/"):
                return self._indices[at]
        return None


def bit_positions(register: Register) -> list[tuple[int, int]]:
    """Return (byte, bit) of each element of a BOOL register, from its first byte on; the last index runs fastest."""
    if not register.dims or register.partial:
        return [divmod((register.bit or 0) + flat, 8) for flat in range(register.count)]
    row = range(register.shape[-1])
    rows = range(0, register.size, -(-len(row) // 8))
    return [(start + column // 8, column % 8) for start in rows for column in row]


def element_position(element: ElementType, shape: tuple[int, ...], flat: int) -> tuple[int, int | None]:
    """Return (byte, bit) of an array's element relative to its start; ``flat`` counts row by row.

    A row of bits begins at a byte; all other elements follow each other at their stride.
    """
    if element.base != "BOOL":
        return flat * element.stride, None
    row, column = divmod(flat, shape[-1])
    return row * -(-shape[-1] // 8) + column // 8, column % 8


def array_size(element: ElementType, shape: tuple[int, ...]) -> int:
    """Return the bytes from the first to the last that holds data; without trailing padding."""
    if not shape:
        return element.size
    if element.base == "BOOL":
        return math.prod(shape[:-1]) * -(-shape[-1] // 8)
    return (math.prod(shape) - 1) * element.stride + element.size
