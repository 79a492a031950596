"""The compiled layout of a block: its registers with their offsets, and the elementary types of S7.

Everything here is immutable and free of I/O. Segments and recordings store a ``Layout`` as JSON, which
``document.py`` reads and ``shmio-layout --json`` prints. Sizes and alignments of the types are those of
a block with standard access, as given in Siemens' STEP 7 help under "Data types";
``docs/reference/layout-rules.md`` has the whole table.
"""

from __future__ import annotations

import math
import operator
import re
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Annotated, Final, Literal

import msgspec

from shmio.errors import PathError
from shmio.layout.encodings import ISO_8859_1

ByteOrder = Literal["big", "little"]
Dims = tuple[tuple[int, int], ...]

MAX_DIMENSIONS = 6
MAX_DEPTH = 32  # nested structures; Siemens allows 8
MAX_STANDARD_BYTES = 65_536  # limit of an S7-1500 for a block with standard access
MAX_BLOCK_BYTES = 1 << 20  # limit of any other block
MAX_REGISTERS = 100_000
MAX_IMAGE_BYTES = MAX_BLOCK_BYTES + 12 * MAX_REGISTERS + 8  # with a status area
MAX_ELEMENTS = 1 << 20  # of all registers together
MAX_STRUCTURES = 200_000  # of a block, including structures without registers
_MAX_STRING = 254
_MAX_WSTRING = 16_382
DEFAULT_STRING = 254
MAX_PATH = 16_384  # characters


class ElementType(msgspec.Struct, frozen=True):
    """An elementary type; a string type includes its length.

    Attributes:
        name: The canonical name, such as ``STRING[20]``; ``DATE_AND_TIME``, not its alias ``DT``.
        base: The name without the length.
        size: Size in bytes; 1 for BOOL, which takes one bit of it.
        align: Alignment in bytes, 1 or 2.
        length: Maximum number of characters of a string, 0 for all other types. STRING counts bytes,
            and WSTRING units of UTF-16.
        encoding: Canonical name of the encoding of CHAR and STRING; "" is ISO 8859-1.

    """

    name: str
    base: str
    size: int
    align: int
    length: int = 0
    encoding: str = ""

    @property
    def stride(self) -> int:
        """Distance from one array element to the next, in bytes. Not valid for BOOL, whose elements are bits."""
        return -(-self.size // self.align) * self.align


_SIZES = {
    1: ("BOOL", "BYTE", "CHAR", "SINT", "USINT"),
    2: ("WORD", "INT", "UINT", "DATE", "S5TIME", "WCHAR"),
    4: ("DWORD", "DINT", "UDINT", "REAL", "TIME", "TIME_OF_DAY"),
    6: ("POINTER",),
    8: ("LWORD", "LINT", "ULINT", "LREAL", "LTIME", "LTOD", "LDT", "DATE_AND_TIME"),
    10: ("ANY",),
    12: ("DTL",),
}
_FIXED = {
    name: ElementType(name, name, size, 1 if size == 1 else 2) for size, names in _SIZES.items() for name in names
}

# The values of hardware data types and parameter types are numbers that identify something. Siemens'
# help gives the underlying type of each ("Hardware data types"; "Format of the parameter types BLOCK,
# COUNTER, TIMER": a binary number in a word).
# fmt: off
_NAMING = {
    "UINT": (
        "HW_ANY", "HW_DEVICE", "HW_DPMASTER", "HW_DPSLAVE", "HW_IO", "HW_IOSYSTEM", "HW_SUBMODULE", "HW_MODULE",
        "HW_INTERFACE", "HW_IEPORT", "HW_HSC", "HW_PWM", "HW_PTO", "PORT", "RTM", "PIP", "DB_ANY", "DB_WWW", "DB_DYN",
        "TIMER", "COUNTER", "BLOCK_FB", "BLOCK_FC", "BLOCK_DB", "BLOCK_SDB",
    ),
    "INT": (
        "OB_ANY", "OB_DELAY", "OB_TOD", "OB_CYCLIC", "OB_ATT", "OB_PCYCLE", "OB_HWINT", "OB_DIAG", "OB_TIMEERROR",
        "OB_STARTUP",
    ),
    "WORD": ("CONN_ANY", "CONN_PRG", "CONN_OUC"),
    "DWORD": ("AOM_IDENT", "EVENT_ANY", "EVENT_ATT", "EVENT_HWINT", "CONN_R_ID", "C_ALARM_S", "C_ALARM_SD"),
    "ANY": ("REMOTE",),
}
# fmt: on
ALIASES = {
    "TOD": "TIME_OF_DAY",
    "DT": "DATE_AND_TIME",
    "LTIME_OF_DAY": "LTOD",
    "DATE_AND_LTIME": "LDT",
    **{alias: name for name, aliases in _NAMING.items() for alias in aliases},
}
BYTE = _FIXED["BYTE"]
POINTER = _FIXED["POINTER"]
STRUCTURED = frozenset({"STRING", "WSTRING", "DATE_AND_TIME", "DTL"})  # made of several values, as Siemens sees it
INTEGERS = frozenset(
    ["BYTE", "WORD", "DWORD", "LWORD", "SINT", "USINT", "INT", "UINT", "DINT", "UDINT", "LINT", "ULINT"]
)
NUMBERS = INTEGERS | {"REAL", "LREAL"}
_STRING = re.compile(r"(W?STRING)(?:\[([0-9]{1,5})\])?")


def is_encoded(name: str) -> bool:
    """Return whether values of a type have the encoding of their register."""
    return name == "CHAR" or name.startswith("STRING")


def string_limit(base: str) -> int:
    """Return the largest length, in characters, that a ``STRING`` or ``WSTRING`` (``base``) may declare."""
    return _MAX_STRING if base == "STRING" else _MAX_WSTRING


@lru_cache(maxsize=1024)
def element_type(name: str) -> ElementType | None:
    """Return the elementary type with this name or alias, in upper or lower case; None if there is none."""
    upper = name.upper()
    fixed = _FIXED.get(ALIASES.get(upper, upper))
    if fixed is not None:
        return fixed
    if (match := _STRING.fullmatch(upper)) is None:
        return None
    base, length = match[1], int(match[2] or DEFAULT_STRING)
    if not 1 <= length <= string_limit(base):
        return None
    size = length + 2 if base == "STRING" else 2 * length + 4
    return ElementType(f"{base}[{length}]", base, size, 2, length)


@lru_cache(maxsize=1024)
def _encoded(element: ElementType, encoding: str) -> ElementType:
    return msgspec.structs.replace(element, encoding=encoding)


_Path = Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_PATH)]
_Bound = Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 31)]
_Size = Annotated[int, msgspec.Meta(ge=0, le=MAX_BLOCK_BYTES)]
_Bit = Annotated[int, msgspec.Meta(ge=0, le=7)]
_Count = Annotated[int, msgspec.Meta(ge=1, le=MAX_ELEMENTS)]
_Unit = Annotated[str, msgspec.Meta(max_length=64)]
_Address = Annotated[str, msgspec.Meta(max_length=4096)]
_Deadband = Annotated[float, msgspec.Meta(ge=0)]
if TYPE_CHECKING:
    _Dims = Dims
else:  # null in the JSON of a scalar; load_layout replaces it by ()
    _Dims = Annotated[tuple[tuple[_Bound, _Bound], ...], msgspec.Meta(min_length=1, max_length=MAX_DIMENSIONS)] | None


class Register(msgspec.Struct, frozen=True, gc=False, forbid_unknown_fields=True):
    """A named, typed value at a fixed place in a block.

    Attributes:
        path: Names of the members and indices, percent-encoded and joined by ``/``, without source
            and direction.
        type: S7 name of the element type in upper case; for strings, with the length:
            ``STRING[20]``.
        dims: (low, high) of each dimension; ``()`` for a scalar.
        offset: First byte in the block.
        bit: 0-7 for BOOL, else None.
        size: Size in bytes, without trailing padding.
        count: Number of elements.
        comment: The source's comment on the member.
        initial: The source's text of the initial value; None: the source gives none.
        partial: Whether this is a slice of an array of bits. The slice begins at ``bit``; its first
            and last byte may hold bits of other registers.
        unit: Unit of the value, such as ``mm/s``; "" if unknown.
        address: Address in the device, in the notation of the source's connector; "" if the
            position in the block is the address.
        scale: (factor, offset) with which the connector computes the value from the device's
            number: value = number * factor + offset. None: the value is the number.
        deadband: Largest change of the value that the connector may ignore.
        writable: Whether the tag table lets commands write the register.
        over: For a register of a tag table over a data block, the path of the part of the block
            that it names; "" for a register that has bytes of its own.
        encoding: Canonical name of the encoding of a CHAR or STRING; "" is ISO 8859-1, and for all
            other types.

    """

    path: _Path
    type: str
    dims: _Dims
    offset: _Size
    bit: _Bit | None
    size: _Size
    count: _Count
    comment: str = ""
    initial: str | None = None
    partial: bool = False
    unit: _Unit = ""
    address: _Address = ""
    scale: tuple[float, float] | None = None
    deadband: _Deadband = 0.0
    writable: bool = False
    over: Annotated[str, msgspec.Meta(max_length=MAX_PATH)] = ""
    encoding: Annotated[str, msgspec.Meta(max_length=64)] = ""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of elements in each dimension."""
        return shape_of(self.dims)

    @property
    def element(self) -> ElementType:
        """The elementary type; raises KeyError for an unknown name, which no validated layout has."""
        found = element_type(self.type)
        if found is None:
            raise KeyError(self.type)
        return _encoded(found, self.encoding) if self.encoding else found


@dataclass(frozen=True)
class Layout:
    """The layout of a block: its registers, and the size of its images.

    Attributes:
        registers: First the registers of the block (:attr:`own`), in address order and without
            overlaps. Then the registers of tag tables over the block, which share bytes of the first.
        size: Size of an image of the block in bytes, including its status area.
        status_offset: Offset of the status area in an image; None: the image has no status area. The
            area holds a status code and a source time for each of the :attr:`own` registers: see
            :class:`shmio.model.statuses.StatusArea`.

    """

    name: str
    number: int | None
    size: int
    optimized: bool
    registers: tuple[Register, ...]
    byte_order: ByteOrder = "big"
    status_offset: int | None = None

    @cached_property
    def by_path(self) -> Mapping[str, int]:
        """The index into ``registers`` for each path."""
        paths = [register.path for register in self.registers]
        return dict(zip(paths, range(len(paths)), strict=True))  # faster than a comprehension with an index

    @cached_property
    def own(self) -> tuple[Register, ...]:
        """The registers of the block itself, in address order and without overlaps; not those of tag tables over it."""
        count = len(self.registers)
        while count and self.registers[count - 1].over:
            count -= 1
        return self.registers[:count]  # slicing a whole tuple makes no copy

    @cached_property
    def base(self) -> Layout:
        """The layout with its :attr:`own` registers only, as programs before version 0.2 read it."""
        return self if len(self.own) == len(self.registers) else replace(self, registers=self.own)

    @cached_property
    def addressed(self) -> bool:
        """True if this is a tag table: its registers have addresses in a device."""
        return any(register.address for register in self.registers)

    @cached_property
    def hash(self) -> bytes:
        """SHA-256 of the canonical JSON: equal for equal layouts."""
        import hashlib  # noqa: PLC0415  programs that only read need no digests, and it loads OpenSSL

        return hashlib.sha256(self.to_json()).digest()

    # A structure is found as a range of sorted paths. A table of all structures could be far larger
    # than the layout.
    @cached_property
    def _sorted(self) -> _Sorted:
        return _Sorted([register.path for register in self.registers])

    @cached_property
    def _sorted_in_lower_case(self) -> _Sorted:
        return _Sorted([register.path.lower() for register in self.registers])

    def members(self, prefix: str) -> tuple[int, ...]:
        """Return the indices of the registers below a structure or an array of structures."""
        return self._sorted.below(prefix)

    def in_any_case(self, path: str) -> str | None:
        """Return the path of a register or structure that equals ``path`` except for case; None if there is none."""
        wanted = path.lower()
        at = self._sorted_in_lower_case.first(wanted)
        if at is None:
            return None
        return "/".join(self.registers[at].path.split("/")[: wanted.count("/") + 1])

    def element(self, register: Register, index: tuple[int, ...]) -> Register:
        """Return one element of an array as a scalar register whose path ends in the index.

        Args:
            register: The array.
            index: One declared index for each dimension.

        Raises:
            PathError: The index is out of bounds or has another number of dimensions.

        """
        if len(index) != len(register.dims) or not all(
            low <= i <= high for i, (low, high) in zip(index, register.dims, strict=True)
        ):
            if not register.dims:
                raise PathError(f"{register.path}: this is a single {register.type}, not an array")
            bounds = ",".join(f"{low}..{high}" for low, high in register.dims)
            raise PathError(f"{register.path}: index {list(index)} is outside [{bounds}]")
        if not index:
            return register
        flat = flat_index(register.dims, index)
        byte, bit = element_position(register.element, register.shape, flat)
        if register.partial:
            byte, bit = divmod((register.bit or 0) + flat, 8)
        return Register(
            path=f"{register.path}/{'/'.join(map(str, index))}",
            type=register.type,
            dims=(),
            offset=register.offset + byte,
            bit=bit,
            size=register.element.size,
            count=1,
            comment=register.comment,
            unit=register.unit,
            encoding=register.encoding,
        )

    def with_encoding(self, encoding: str) -> Layout:
        """Return the layout with another encoding of its CHARs and STRINGs, given by its canonical name."""
        name = "" if encoding == ISO_8859_1 else encoding
        registers = (
            msgspec.structs.replace(one, encoding=name) if one.encoding != name and is_encoded(one.type) else one
            for one in self.registers
        )
        return replace(self, registers=tuple(registers))

    def with_statuses(self) -> Layout:
        """Return the layout with a status area after its registers; this layout if it has one already."""
        if self.status_offset is not None:
            return self
        start = -(-self.size // 8) * 8
        return replace(self, status_offset=start, size=start + status_bytes(len(self.own)))

    def describe(self) -> dict[str, object]:
        """Return the layout as the object that ``shmio-layout --json`` prints, without ``byte_order``.

        Keys for tag tables and status areas are left out if they have no value.
        """
        described: dict[str, object] = {
            "name": self.name,
            "number": self.number,
            "size": self.size,
            "optimized": self.optimized,
            "registers": [_describe(register) for register in self.registers],
        }
        if self.status_offset is not None:
            described["status_offset"] = self.status_offset
        return described

    def to_json(self) -> bytes:
        """Return :meth:`describe` and ``byte_order`` as canonical JSON: fixed order of keys, no white space, UTF-8."""
        return self._json

    @cached_property
    def _json(self) -> bytes:
        return msgspec.json.encode(self.describe() | {"byte_order": self.byte_order})


_OF_TAGS: Final = {
    "unit": "", "address": "", "scale": None, "deadband": 0.0, "writable": False, "over": "", "encoding": "",
}  # fmt: skip
"""The keys that only some registers have, mostly those of tag tables, and their default values."""
_tags_of: Final = operator.attrgetter(*_OF_TAGS)
_NO_TAGS: Final = tuple(_OF_TAGS.values())


def _describe(register: Register) -> Mapping[str, object]:
    described = {
        "path": register.path,
        "type": register.type,
        "dims": [list(bounds) for bounds in register.dims] if register.dims else None,
        "offset": register.offset,
        "bit": register.bit,
        "size": register.size,
        "count": register.count,
        "comment": register.comment,
        "initial": register.initial,
    }
    if (tags := _tags_of(register)) != _NO_TAGS:
        for (name, default), given in zip(_OF_TAGS.items(), tags, strict=True):
            if given != default:
                described[name] = given
    return described


class _Sorted:
    """The paths of a layout in sorted order, with their indices; paths below a structure are adjacent."""

    def __init__(self, paths: Sequence[str]) -> None:
        self._indices = sorted(range(len(paths)), key=paths.__getitem__)
        self._paths = [paths[index] for index in self._indices]

    def below(self, prefix: str) -> tuple[int, ...]:
        """Return the ascending indices of the paths below the prefix."""
        start = bisect_left(self._paths, f"{prefix}/")
        stop = bisect_left(self._paths, f"{prefix}0", start)  # "0" follows "/" in Unicode
        return tuple(sorted(self._indices[start:stop]))

    def first(self, path: str) -> int | None:
        """Return the index of the path, or else of the first path below it; None if there is neither."""
        for at in (bisect_left(self._paths, path), bisect_left(self._paths, f"{path}/")):
            if at < len(self._paths) and f"{self._paths[at]}/".startswith(f"{path}/"):
                return self._indices[at]
        return None


def status_bytes(registers: int) -> int:
    """Return the size in bytes of a status area for a number of registers.

    The area has a code of 4 bytes for each register, padding to a multiple of 8 bytes, and a time
    of 8 bytes for each register.
    """
    return -(-4 * registers // 8) * 8 + 8 * registers


def shape_of(dims: Dims) -> tuple[int, ...]:
    """Return the number of elements in each dimension."""
    return tuple(high - low + 1 for low, high in dims)


def flat_index(dims: Dims, index: tuple[int, ...]) -> int:
    """Return the position, from 0, of the element of an array with these declared indices.

    The last index varies fastest.
    """
    flat = 0
    for i, (low, high) in zip(index, dims, strict=True):
        flat = flat * (high - low + 1) + i - low
    return flat


def index_at(dims: Dims, flat: int) -> tuple[int, ...]:
    """Return the declared indices of the array element at position ``flat``: the reverse of :func:`flat_index`."""
    index: tuple[int, ...] = ()
    for low, high in reversed(dims):
        flat, place = divmod(flat, high - low + 1)
        index = (low + place, *index)
    return index


def bit_positions(register: Register) -> list[tuple[int, int]]:
    """Return (byte, bit) of each element of a BOOL register, relative to its first byte.

    The last index varies fastest.
    """
    if not register.dims or register.partial:
        return [divmod((register.bit or 0) + flat, 8) for flat in range(register.count)]
    row = range(register.shape[-1])
    rows = range(0, register.size, -(-len(row) // 8))
    return [(start + column // 8, column % 8) for start in rows for column in row]


def element_position(element: ElementType, shape: tuple[int, ...], flat: int) -> tuple[int, int | None]:
    """Return (byte, bit) of an array element relative to the array's start.

    ``flat`` counts elements row by row. In an array of BOOL, each row begins at a whole byte.
    Elements of other types are spaced by their stride.
    """
    if element.base != "BOOL":
        return flat * element.stride, None
    row, column = divmod(flat, shape[-1])
    return row * -(-shape[-1] // 8) + column // 8, column % 8


def array_size(element: ElementType, shape: tuple[int, ...]) -> int:
    """Return an array's size in bytes, without trailing padding."""
    if not shape:
        return element.size
    if element.base == "BOOL":
        return math.prod(shape[:-1]) * -(-shape[-1] // 8)
    return (math.prod(shape) - 1) * element.stride + element.size
