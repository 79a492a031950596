"""Tag tables to layouts: the registers of a source that has no data block, as a TOML file names them.

::

    name = "cell"                 # optional: the file's name
    [registers]
    "joints/R3200/Link1/R/position" = "LREAL"
    "joints/Kuka.j1/R" = { type = "LREAL", initial = 0.5, comment = "rad" }
    "lamps" = { type = "ARRAY[1..8] OF BOOL", initial = [true] }

Keys are paths as in topics, types those of S7. Values lie in the order of the file, each at a multiple of its size, in
the byte order ``byte_order`` (default: little, as this machine's); a single BOOL has a byte of its own.
"""

from __future__ import annotations

import math
import re
import tomllib
from contextlib import suppress
from pathlib import PurePath
from typing import Annotated, Final

import msgspec

from shmio.errors import PathError, ValueRangeError
from shmio.layout.lexer import MAX_SOURCE_BYTES
from shmio.layout.literal import parse_literal
from shmio.layout.model import (
    MAX_BLOCK_BYTES,
    MAX_DIMENSIONS,
    MAX_ELEMENTS,
    MAX_REGISTERS,
    ByteOrder,
    Diagnostic,
    Dims,
    Layout,
    Register,
    array_size,
)
from shmio.layout.report import Report, TooManyErrors
from shmio.layout.topic import MAX_TOPIC, canonical_path
from shmio.layout.types import ElementType, element_type

SUFFIX: Final = ".toml"
MAX_ALIGN: Final = 8

_ARRAY = re.compile(r"ARRAY\s*\[([^\]]*)\]\s*OF\s+(\S+)", re.IGNORECASE)
_BOUNDS = re.compile(r"\s*(-?[0-9]{1,9})\s*\.\.\s*(-?[0-9]{1,9})\s*")
_LINE = re.compile(r" \(at line ([0-9]+), column ([0-9]+)\)")
_TEXTS: Final = frozenset({"STRING", "WSTRING", "CHAR", "WCHAR"})

_Scalar = bool | int | float | str


class _Tag(msgspec.Struct, forbid_unknown_fields=True):
    type: str
    initial: _Scalar | list[_Scalar] | None = None
    comment: Annotated[str, msgspec.Meta(max_length=1000)] = ""


class _Table(msgspec.Struct, forbid_unknown_fields=True):
    registers: Annotated[dict[str, str | _Tag], msgspec.Meta(min_length=1, max_length=MAX_REGISTERS)]
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)] = ""
    byte_order: ByteOrder = "little"


def compile_tags(file: str, data: bytes) -> Layout:
    """Compile one tag table. LayoutError: ``diagnostics`` has everything found."""
    report = Report([file])
    table = _read(file, data, report)
    report.raise_errors()
    placer = _Placer(file, data.decode(), report)
    with suppress(TooManyErrors):
        placer.place(table)
    report.raise_errors()
    return placer.layout(table)


def _read(file: str, data: bytes, report: Report) -> _Table:
    """The file as it stands; an empty table after an error."""
    if len(data) > MAX_SOURCE_BYTES:
        report.add(Diagnostic(file, 1, 1, f"the file is larger than {MAX_SOURCE_BYTES} bytes"))
        return _Table({})
    try:
        return msgspec.convert(tomllib.loads(data.decode()), _Table)
    except UnicodeDecodeError as error:
        report.add(Diagnostic(file, data.count(b"\n", 0, error.start) + 1, 1, "it is not in UTF-8"))
    except tomllib.TOMLDecodeError as error:
        where = _LINE.search(str(error))
        line, column = (int(where[1]), int(where[2])) if where else (1, 1)
        report.add(Diagnostic(file, line, column, _LINE.sub("", str(error))))
    except (msgspec.ValidationError, RecursionError) as error:
        report.add(Diagnostic(file, 1, 1, f"it is no tag table: {error}"))
    return _Table({})


class _Placer:
    """Places one table's registers one after the other."""

    def __init__(self, file: str, text: str, report: Report) -> None:
        self._file = file
        self._text = text
        self._report = report
        self._registers: dict[str, Register] = {}
        self._end = 0
        self._elements = 0

    def place(self, table: _Table) -> None:
        """Place all registers; TooManyErrors."""
        for key, given in table.registers.items():
            try:
                self._place(key, _Tag(given) if isinstance(given, str) else given)
            except (PathError, ValueRangeError, ValueError) as error:
                self._complain(key, str(error))
        for path in self._registers:
            head = path.rpartition("/")[0]
            while head:
                if head in self._registers:
                    self._complain(path, f"{head} is a value itself")
                head = head.rpartition("/")[0]
        if self._end > MAX_BLOCK_BYTES or self._elements > MAX_ELEMENTS:
            most = f"{MAX_BLOCK_BYTES} bytes and {MAX_ELEMENTS} elements"
            self._report.add(Diagnostic(self._file, 1, 1, f"expected at most {most}, found more"))

    def layout(self, table: _Table) -> Layout:
        """What came of it."""
        name = table.name or PurePath(self._file).stem
        return Layout(name, None, self._end, False, tuple(self._registers.values()), table.byte_order)

    def _complain(self, key: str, problem: str) -> None:
        self._report.add(Diagnostic(self._file, self._line(key), 1, f"{key}: {problem}"))

    def _place(self, key: str, tag: _Tag) -> None:
        path = canonical_path(key)
        if len(path) > MAX_TOPIC:
            raise PathError(f"a path is at most {MAX_TOPIC} characters long")
        if path.rpartition("/")[2] != key.rpartition("/")[2] and key.rpartition("/")[2] in ("in", "out"):
            raise PathError("it ends in a direction; leave it out, each register has both")
        if path in self._registers:
            raise PathError("it is there twice")
        element, dims = _type(tag.type)
        shape = tuple(high - low + 1 for low, high in dims)
        bit = 0 if element.base == "BOOL" else None
        size, align = array_size(element, shape), _align(element)
        offset = -(-self._end // align) * align
        initial = None if tag.initial is None else _literal(tag.initial, element)
        register = Register(path, element.name, dims, offset, bit, size, math.prod(shape), tag.comment, initial)
        if initial is not None:
            parse_literal(initial, register)
        self._registers[path] = register
        self._end = offset + size
        self._elements += register.count

    def _line(self, key: str) -> int:
        """Where a key stands, as far as a search finds it."""
        at = max(self._text.find(f'"{key}"'), self._text.find(f"'{key}'"), self._text.find(f"\n{key}") + 1, 0)
        return self._text.count("\n", 0, at) + 1


def _type(text: str) -> tuple[ElementType, Dims]:
    """Type of the elements and bounds; ValueError."""
    dims: list[tuple[int, int]] = []
    if array := _ARRAY.fullmatch(text.strip()):
        for part in array[1].split(","):
            bounds = _BOUNDS.fullmatch(part)
            if bounds is None or int(bounds[1]) > int(bounds[2]):
                raise ValueError(f"expected bounds as in ARRAY[1..8] OF BOOL, found [{array[1]}]")
            dims.append((int(bounds[1]), int(bounds[2])))
        if len(dims) > MAX_DIMENSIONS:
            raise ValueError(f"expected at most {MAX_DIMENSIONS} dimensions, found {len(dims)}")
        text = array[2]
    if math.prod(high - low + 1 for low, high in dims) > MAX_ELEMENTS:
        raise ValueError(f"expected at most {MAX_ELEMENTS} elements")
    element = element_type(text.strip())
    if element is None:
        raise ValueError(f"there is no type {text!r}; there are BOOL, INT, DINT, REAL, LREAL, STRING[20] and the like")
    return element, tuple(dims)


def _align(element: ElementType) -> int:
    return min(element.size, MAX_ALIGN) if element.size & element.size - 1 == 0 else element.align


def _literal(value: _Scalar | list[_Scalar], element: ElementType) -> str:
    """An initial value as S7 has it. Text for a number or a time is such a literal already."""
    if isinstance(value, list):
        return f"[{', '.join(_literal(item, element) for item in value)}]"
    if isinstance(value, str):
        if element.base not in _TEXTS:
            return value
        escaped = value.replace("$", "$$").replace("'", "$'")
        return f"{'W' + element.base.removeprefix('W') + '#' if element.base.startswith('W') else ''}'{escaped}'"
    return str(value).upper() if isinstance(value, bool) else repr(value)
