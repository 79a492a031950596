"""Tag tables to layouts: the registers of a source that has no data block, as a TOML file names them.

::

    name = "cell"                 # optional: the file's name
    [registers]
    "joints/R3200/Link1/R/position" = "LREAL"
    "joints/Kuka.j1/R" = { type = "LREAL", initial = 0.5, comment = "rad" }
    "lamps" = { type = "ARRAY[1..8] OF BOOL", initial = [true] }

Keys are paths as in topics, types those of S7. Values lie in the order of the file, each at a multiple of its size, in
the byte order ``byte_order`` (default: little, as this machine's); a single BOOL has a byte of its own. Initial values
of an array are one list, in the order of its elements.
"""

from __future__ import annotations

import math
import re
import tomllib
from contextlib import suppress
from functools import cached_property
from pathlib import PurePath
from typing import Annotated, Final, Literal

import msgspec

from shmio.config.wording import explain, explain_toml
from shmio.errors import PathError, ValueRangeError
from shmio.layout.lexer import MAX_SOURCE_BYTES
from shmio.layout.lists import split_array
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
from shmio.layout.topic import MAX_TOPIC, canonical_path, shorten
from shmio.layout.types import ElementType, element_type
from shmio.logs import printable

SUFFIX: Final = ".toml"
MAX_ALIGN: Final = 8

_ARRAY = re.compile(r"ARRAY\s*\[([^\]]*)\]\s*OF\s+(\S+)", re.IGNORECASE)
_BOUNDS = re.compile(r"\s*(-?[0-9]{1,9})\s*\.\.\s*(-?[0-9]{1,9})\s*")
_PLACE = re.compile(r" \(at (?:line ([0-9]+), column ([0-9]+)|end of document)\)")
_LONG_NUMBER = re.compile(r"[0-9_]{4300}")
_NAME = r"""("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*"""
_TABLE = r"registers[ \t]*\.[ \t]*"
_KEY = re.compile(rf"^[ \t]*(?:(?:{_TABLE})?{_NAME}[.=]|\[[ \t]*{_TABLE}{_NAME}[].])", re.MULTILINE)
_TEXTS: Final = frozenset({"STRING", "WSTRING", "CHAR", "WCHAR"})

_Scalar = bool | int | float | str


class _Tag(msgspec.Struct, forbid_unknown_fields=True):
    type: str
    initial: _Scalar | list[_Scalar] | None = None
    comment: Annotated[str, msgspec.Meta(max_length=1000)] = ""


class _Table(msgspec.Struct, forbid_unknown_fields=True):
    registers: Annotated[dict[str, object], msgspec.Meta(min_length=1, max_length=MAX_REGISTERS)]
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)] = ""
    byte_order: ByteOrder = "little"


def compile_tags(file: str, data: bytes, report: Report) -> Layout:
    """Compile one tag table; warnings are left in the report. LayoutError: ``diagnostics`` has everything found."""
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
        text = data.decode()
    except UnicodeDecodeError as error:
        report.add(Diagnostic(file, data.count(b"\n", 0, error.start) + 1, 1, "it is not in UTF-8"))
        return _Table({})
    try:
        return msgspec.convert(tomllib.loads(text), _Table)
    except msgspec.ValidationError as error:
        report.add(Diagnostic(file, 1, 1, f"it is no tag table: {explain(error)}"))
    except (ValueError, RecursionError) as error:
        report.add(_syntax_error(file, text, error))
    return _Table({})


def _syntax_error(file: str, text: str, error: Exception) -> Diagnostic:
    """What tomllib refuses, at its place."""
    where = _PLACE.search(str(error))
    if where is None:
        number = _LONG_NUMBER.search(text)
        return Diagnostic(file, text.count("\n", 0, number.start()) + 1 if number else 1, 1, explain_toml(error, text))
    lines = text.split("\n")
    line, column = (int(where[1]), int(where[2])) if where[1] else (len(lines), len(lines[-1]) + 1)
    if not str(error).startswith("Cannot overwrite a value"):
        hint = "; a path is written in quotes" if str(error).startswith("Expected '='") else ""
        return Diagnostic(file, line, column, f"{_PLACE.sub('', explain_toml(error, text))}{hint}")
    while line > 1 and not _KEY.match(lines[line - 1]):
        line -= 1  # found at the value's end
    key = shorten(lines[line - 1].partition("=")[0].strip())
    return Diagnostic(file, line, 1, f"{key}: it is there twice; a path with a dot is written in quotes")


class _Placer:
    """Places one table's registers one after the other."""

    def __init__(self, file: str, text: str, report: Report) -> None:
        self._file = file
        self._text = text
        self._report = report
        self._registers: dict[str, Register] = {}
        self._keys: dict[str, str] = {}  # of the paths, as the file has them
        self._end = 0
        self._elements = 0

    def place(self, table: _Table) -> None:
        """Place all registers; TooManyErrors."""
        for key, given in table.registers.items():
            try:
                self._place(key, _tag(key, given))
            except (PathError, ValueRangeError, ValueError) as error:
                self._complain(key, str(error))
        in_lower_case: dict[str, str] = {}
        for path in self._registers:
            first = in_lower_case.setdefault(path.lower(), path)
            if first != path:
                problem = f"only the case of letters tells it from {shorten(first)}"
                self._complain(self._keys[path], problem, "warning")
            head = path.rpartition("/")[0]
            while head:
                if head in self._registers:
                    self._complain(self._keys[path], f"{shorten(head)} is a value itself")
                head = head.rpartition("/")[0]
        if self._end > MAX_BLOCK_BYTES or self._elements > MAX_ELEMENTS:
            most = f"{MAX_BLOCK_BYTES} bytes and {MAX_ELEMENTS} elements"
            self._report.add(Diagnostic(self._file, 1, 1, f"expected at most {most}, found more"))

    def layout(self, table: _Table) -> Layout:
        """What came of it."""
        name = table.name or PurePath(self._file).stem
        return Layout(name, None, self._end, False, tuple(self._registers.values()), table.byte_order)

    def _complain(self, key: str, problem: str, severity: Literal["error", "warning"] = "error") -> None:
        message = f"{shorten(printable(key))}: {problem}"
        self._report.add(Diagnostic(self._file, self._lines.get(key, 1), 1, message, severity))

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
            _check_length(initial, shape)
        self._registers[path] = register
        self._keys[path] = key
        self._end = offset + size
        self._elements += register.count

    @cached_property
    def _lines(self) -> dict[str, int]:
        """Where each key stands, as far as a search finds it; the last place of several."""
        lines: dict[str, int] = {}
        line, counted = 1, 0
        for match in _KEY.finditer(self._text):
            line += self._text.count("\n", counted, match.start())
            counted = match.start()
            key = match[1] or match[2]
            if key.startswith('"') and "\\" in key:
                with suppress(ValueError):  # in a text of several lines it may be no key at all
                    lines |= dict.fromkeys(tomllib.loads(f"{key} = 0"), line)
            else:
                lines[key[1:-1] if key[0] in "\"'" else key] = line
        return lines


def _tag(key: str, given: object) -> _Tag:
    """One register's entry; ValueError."""
    if isinstance(given, str):
        return _Tag(given)
    if isinstance(given, dict) and (others := given.keys() - set(_Tag.__struct_fields__)):
        other = min(others)
        known = ", ".join(_Tag.__struct_fields__)
        raise ValueError(
            f"there is no {shorten(printable(other))!r} here, only {known}; a path with a dot is written in quotes, "
            f'"{shorten(printable(f"{key}.{other}"))}"'
        )
    try:
        return msgspec.convert(given, _Tag)
    except msgspec.ValidationError as error:
        if isinstance(given, dict) and _is_nested(given.get("initial")):
            raise ValueError(
                "initial: expected one list, in which the last index runs fastest, found lists in it"
            ) from None
        raise ValueError(explain(error)) from None


def _is_nested(initial: object) -> bool:
    return isinstance(initial, list) and any(isinstance(value, list) for value in initial)


def _check_length(initial: str, shape: tuple[int, ...]) -> None:
    """Refuse more values than the array has elements; ValueError."""
    if shape:
        runs = split_array(initial, (shape[0] + 1, *shape[1:]))
        if runs and runs[-1][0] + runs[-1][1] > math.prod(shape):
            raise ValueError(f"initial: expected at most {math.prod(shape)} values, found more")


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
    if isinstance(value, int) and abs(value) >> 64:
        raise ValueError("initial: expected a number of at most 64 bits, found a larger one")
    return str(value).upper() if isinstance(value, bool) else repr(value)
