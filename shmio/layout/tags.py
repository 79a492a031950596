"""Compile tag tables: files that name the registers of a source without a data block.

A table is a TOML file, or a sheet (``tag_sheets.py``) with the same columns. In TOML::

    name = "cell"                 # optional: the file's name
    [registers]
    "joints/R3200/Link1/R/position" = "LREAL"
    "joints/Kuka.j1/R" = { type = "LREAL", initial = 0.5, unit = "rad" }
    "pump/Speed" = { type = "REAL", address = "holding 100", scale = 0.1, writable = true }
    "lamps" = { type = "ARRAY[1..8] OF BOOL", initial = [true] }
    "safetyzones/Z1" = "SafetyZone"

Keys are paths as in topics. Types are those of S7, or known structures (``simlog_structures.py``),
whose members become registers. The block has the values in the order of the file, each at a
multiple of its size, and in the byte order ``byte_order`` (default: little, as on this machine). A
single BOOL takes a byte of its own. The initial values of an array are one list, in the order of
its elements.

``address`` is the address of the value in the device, in the notation of the source's connector.
With ``scale = factor`` or ``scale = [factor, offset]``, the connector computes the value from the
device's number: number * factor + offset. ``deadband`` is the largest change of the value that the
connector may ignore. ``writable = true`` has the same effect as naming the register in the
source's ``writable``. ``word_order`` and ``byte_order`` of a register override those of a Modbus
source. They become a part of the address, so that layouts need no keys for one protocol.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import PurePath
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec
from msgspec.structs import replace

from shmio.config.faults import MAX_PARTS, explain, explain_toml, too_long
from shmio.errors import CharacterError, Diagnostic, LayoutError, PathError, ValueRangeError
from shmio.layout import tag_sheets
from shmio.layout.model import (
    MAX_BLOCK_BYTES,
    MAX_DIMENSIONS,
    MAX_ELEMENTS,
    MAX_REGISTERS,
    NUMBERS,
    ByteOrder,
    Dims,
    ElementType,
    Layout,
    Register,
    array_size,
    element_type,
    shape_of,
)
from shmio.layout.report import Report, TooManyErrors
from shmio.layout.simlog_structures import CONTENTS, members
from shmio.layout.source.lexer import MAX_SOURCE_BYTES
from shmio.layout.topic import MAX_TOPIC, canonical_path, shorten
from shmio.layout.values.literal import parse_literal, split_array
from shmio.wording import did_you_mean, larger_than, near, printable, unknown

SUFFIXES: Final = (".toml", *tag_sheets.SUFFIXES)
_MAX_ALIGN: Final = 8
_PLACE = re.compile(r" \(at (?:line ([0-9]+), column ([0-9]+)|end of document)\)")
_LONG_NUMBER = re.compile(r"[0-9_]{4300}")
_NAME = r"""("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*"""
_TABLE = r"registers[ \t]*\.[ \t]*"
_KEY = re.compile(rf"^[ \t]*(?:(?:{_TABLE})?{_NAME}[.=]|\[[ \t]*{_TABLE}{_NAME}[].])", re.MULTILINE)
_ARRAY = re.compile(r"ARRAY\s*\[([^\]]*)\]\s*OF\s+(\S+)", re.IGNORECASE)
_BOUNDS = re.compile(r"\s*(-?[0-9]{1,9})\s*\.\.\s*(-?[0-9]{1,9})\s*")
_PATH = re.compile(r"[/.%]")
TEXTS: Final = frozenset({"STRING", "WSTRING", "CHAR", "WCHAR"})
_COMMON: Final = (*NUMBERS, *TEXTS, "BOOL", "TIME", "LTIME", "DATE", *CONTENTS)
"""The types to suggest in place of a misspelled type."""
_Scalar = bool | int | float | str
_Read = TypeVar("_Read")


OF_SOURCES: Final = ("quality", "time")
"""Keys that a register cannot have, but a source of MQTT."""


class _Tag(msgspec.Struct, forbid_unknown_fields=True):
    type: str
    initial: _Scalar | list[_Scalar] | None = None
    comment: Annotated[str, msgspec.Meta(max_length=1000)] = ""
    unit: Annotated[str, msgspec.Meta(max_length=64)] = ""
    address: Annotated[str, msgspec.Meta(max_length=4096)] = ""
    scale: float | tuple[float, float] | None = None
    deadband: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    writable: bool = False
    word_order: ByteOrder | None = None
    byte_order: ByteOrder | None = None


class _Table(msgspec.Struct, forbid_unknown_fields=True):
    """Content of a TOML file with a tag table."""

    registers: Annotated[dict[str, object], msgspec.Meta(min_length=1, max_length=MAX_REGISTERS)]
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=128)] = ""
    byte_order: ByteOrder = "little"


def compile_tags(file: str, data: bytes, report: Report, encoding: str = "") -> Layout:
    """Compile one tag table; add warnings to the report.

    ``encoding`` is that of a CSV file that is not in UTF-8.

    Raises:
        LayoutError: The table is wrong; ``diagnostics`` has all errors and warnings.
    """
    if file.lower().endswith(tag_sheets.SUFFIXES):
        return _compile_sheet(file, data, report, encoding)
    table = read_toml(file, data, report, _Table)
    lines = Lines(data.decode())
    return _place_table(file, table, report, lines.line_of)


def _compile_sheet(file: str, data: bytes, report: Report, encoding: str) -> Layout:
    """Compile a table in a CSV file or a spreadsheet; raise LayoutError as :func:`compile_tags` does."""
    sheet = read_sheet(file, data, report, encoding=encoding)
    return _place_table(file, _Table(dict(sheet.registers)), report, lambda path: sheet.rows.get(path, 1))


def read_sheet(
    file: str, data: bytes, report: Report, needed: Sequence[str] = ("path", "type"), encoding: str = ""
) -> tag_sheets.Sheet:
    """Read the rows of a CSV file or a spreadsheet; raise LayoutError if any are wrong."""
    if len(data) > MAX_SOURCE_BYTES:
        report.add(Diagnostic(file, 1, 1, larger_than(MAX_SOURCE_BYTES)))
        report.raise_errors()
    sheet = tag_sheets.read_sheet(file, data, report, needed, encoding)
    report.raise_errors()
    return sheet


def place_tags(name: str, registers: Mapping[str, object], byte_order: ByteOrder = "little") -> Layout:
    """Return a layout of registers that a program declares.

    Args:
        name: Name of the block.
        registers: Entries by path, as in a tag table: the type, or a dict with the keys of an
            entry.
        byte_order: Byte order of the values.

    Returns:
        The layout.

    Raises:
        LayoutError: A register is wrong; the message of each diagnostic begins with the path.

    """
    places = {path: place for place, path in enumerate(registers, 1)}
    return _place_table(name, _Table(dict(registers), name, byte_order), Report([name]), places.__getitem__)


def read_toml(file: str, data: bytes, report: Report, kind: type[_Read]) -> _Read:
    """Return the content of a TOML file as an object of type ``kind``; raise LayoutError if it cannot be read."""
    found = _read(file, data, report, kind)
    report.raise_errors()
    if found is None:
        raise LayoutError(f"{file}: the file cannot be read")
    return found


def _read(file: str, data: bytes, report: Report, kind: type[_Read]) -> _Read | None:
    """Return the file's content as ``kind``; after an error report it and return None."""
    if len(data) > MAX_SOURCE_BYTES:
        report.add(Diagnostic(file, 1, 1, larger_than(MAX_SOURCE_BYTES)))
        return None
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        report.add(
            Diagnostic(file, data.count(b"\n", 0, error.start) + 1, 1, "the file is not UTF-8; save it as UTF-8")
        )
        return None
    if line := too_long(text, MAX_SOURCE_BYTES):
        what = f"a key has more than {MAX_PARTS} parts; write a path with dots in quotes"
        report.add(Diagnostic(file, line, 1, what))
        return None
    tables: dict[str, Any] = {}
    try:
        tables = tomllib.loads(text)
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        report.add(Diagnostic(file, 1, 1, f"the file is not a tag table: {explain(error, '', kind, tables)}"))
    except (ValueError, RecursionError) as error:
        report.add(_syntax_error(file, text, error))
    return None


def _syntax_error(file: str, text: str, error: Exception) -> Diagnostic:
    """Return an error of tomllib as a diagnostic with line and column."""
    where = _PLACE.search(str(error))
    if where is None:
        number = _LONG_NUMBER.search(text)
        return Diagnostic(file, text.count("\n", 0, number.start()) + 1 if number else 1, 1, explain_toml(error, text))
    lines = text.split("\n")
    line, column = (int(where[1]), int(where[2])) if where[1] else (len(lines), len(lines[-1]) + 1)
    if not str(error).startswith("Cannot overwrite a value"):
        hint = "; write a path in quotes" if str(error).startswith("Expected '='") else ""
        return Diagnostic(file, line, column, f"{_PLACE.sub('', explain_toml(error, text))}{hint}")
    while line > 1 and not _KEY.match(lines[line - 1]):
        line -= 1  # tomllib reports the end of the value
    key = shorten(lines[line - 1].partition("=")[0].strip())
    return Diagnostic(file, line, 1, f"{key}: this key is given twice; write a path with a dot in quotes")


class Lines:
    """Finds the line of a key in a table. The text is not searched before the first question."""

    def __init__(self, text: str) -> None:
        self._text = text

    def line_of(self, key: str) -> int:
        """Return the last line on which the key occurs; 1 if it is not found."""
        return self._found.get(key, 1)

    @cached_property
    def _found(self) -> dict[str, int]:
        lines: dict[str, int] = {}
        line, counted = 1, 0
        for match in _KEY.finditer(self._text):
            line += self._text.count("\n", counted, match.start())
            counted = match.start()
            key = match[1] or match[2]
            if key.startswith('"') and "\\" in key:
                with suppress(ValueError):  # the line may be part of a multi-line string
                    lines |= dict.fromkeys(tomllib.loads(f"{key} = 0"), line)
            else:
                lines[key[1:-1] if key[0] in "\"'" else key] = line
        return lines


def _place_table(file: str, table: _Table, report: Report, line_of: Callable[[str], int]) -> Layout:
    """Place a table's registers.

    ``line_of`` returns the line of a key, for diagnostics.

    Raises:
        LayoutError: A register is wrong; ``diagnostics`` has all errors and warnings.
    """
    placer = _Placer(file, report, line_of)
    with suppress(TooManyErrors):
        placer.place(table)
    report.raise_errors()
    return placer.layout(table)


class _Placer:
    """Places one table's registers one after the other."""

    def __init__(self, file: str, report: Report, line_of: Callable[[str], int]) -> None:
        self._file = file
        self._report = report
        self._line_of = line_of
        self._registers: dict[str, Register] = {}
        self._keys: dict[str, str] = {}  # keys as the file has them, by path
        self._end = 0
        self._elements = 0

    def place(self, table: _Table) -> None:
        """Place all registers and report errors.

        Raises:
            TooManyErrors: The report is full.
        """
        for key, given in table.registers.items():
            try:
                self._place_all(key, _tag(key, given))
            except (PathError, ValueRangeError, ValueError) as error:
                self._complain(key, str(error))
        in_lower_case: dict[str, str] = {}
        for path in self._registers:
            first = in_lower_case.setdefault(path.lower(), path)
            if first != path:
                problem = f"this path differs from {shorten(first)} only in upper and lower case"
                self._complain(self._keys[path], problem, "warning")
            head = path.rpartition("/")[0]
            while head:
                if head in self._registers:
                    self._complain(self._keys[path], f"{shorten(head)} is already a register; choose another path")
                head = head.rpartition("/")[0]
        if self._end > MAX_BLOCK_BYTES or self._elements > MAX_ELEMENTS:
            what = f"the registers have more than {MAX_BLOCK_BYTES} bytes or {MAX_ELEMENTS} elements"
            self._report.add(Diagnostic(self._file, 1, 1, what))

    def layout(self, table: _Table) -> Layout:
        """Return the layout of the placed registers."""
        name = table.name or PurePath(self._file).stem
        return Layout(name, None, self._end, False, tuple(self._registers.values()), table.byte_order)

    def _complain(self, key: str, problem: str, severity: Literal["error", "warning"] = "error") -> None:
        message = f"{shorten(printable(key))}: {problem}"
        self._report.add(Diagnostic(self._file, self._line_of(key), 1, message, severity))

    def _place_all(self, key: str, tag: _Tag) -> None:
        """Place the register of an entry; if its type is a structure, place its members."""
        if key.rpartition("/")[2] in ("in", "out"):
            raise PathError("leave out /in or /out at the end of the path, because each register has both")
        inside = members(tag.type)
        if inside is None:
            self._place(key, key, tag)
            return
        if tag.initial is not None:
            raise ValueError("initial: a structure has no initial value; list its members to give them values")
        for name, kind in inside.items():
            self._place(key, f"{key}/{name}", replace(tag, type=kind))

    def _place(self, key: str, name: str, tag: _Tag) -> None:
        path = canonical_path(name)
        if len(path) > MAX_TOPIC:
            raise PathError(f"a path is at most {MAX_TOPIC} characters long")
        if path in self._registers:
            raise PathError("this path is given twice; remove one of the entries")
        if len(self._registers) >= MAX_REGISTERS:
            self._complain(key, f"there are more than {MAX_REGISTERS} registers, with the members of structures")
            raise TooManyErrors
        element, dims = parse_type(tag.type)
        shape = shape_of(dims)
        bit = 0 if element.base == "BOOL" else None
        size, align = array_size(element, shape), _align(element)
        offset = -(-self._end // align) * align
        initial = None if tag.initial is None else _literal(tag.initial, element)
        register = Register(
            path, element.name, dims, offset, bit, size, math.prod(shape), tag.comment, initial,
            unit=tag.unit, address=_address(tag), scale=_scale(tag, element), deadband=_deadband(tag, element),
            writable=tag.writable,
        )  # fmt: skip
        if initial is not None:
            with suppress(CharacterError):  # whoever uses the table knows its encoding
                parse_literal(initial, register)
            _check_length(initial, shape)
        self._registers[path] = register
        self._keys[path] = key
        self._end = offset + size
        self._elements += register.count


def _address(tag: _Tag) -> str:
    """Return the address with the orders of words and bytes; raise ValueError if there is no address to have them."""
    orders = [
        f" {key}={order}" for key, order in (("word_order", tag.word_order), ("byte_order", tag.byte_order)) if order
    ]
    if orders and not tag.address:
        raise ValueError(
            f"{orders[0].split('=')[0].strip()}: only a Modbus address has an order; add the key `address`"
        )
    return tag.address + "".join(orders)


def _scale(tag: _Tag, element: ElementType) -> tuple[float, float] | None:
    """Return (factor, offset); None if there is no scale. Raise ValueError if it is wrong or does not suit the type."""
    if tag.scale is None:
        return None
    factor, offset = tag.scale if isinstance(tag.scale, tuple) else (tag.scale, 0.0)
    if element.base not in NUMBERS:
        raise ValueError(f"scale: a {element.base} cannot be scaled, only numbers can")
    if not factor or not math.isfinite(factor) or not math.isfinite(offset):
        raise ValueError("scale: expected a finite factor other than 0, or [factor, offset]")
    return factor, offset


def _deadband(tag: _Tag, element: ElementType) -> float:
    """Return the dead-band; raise ValueError if it is wrong, or if the type cannot have one."""
    if tag.deadband and element.base not in NUMBERS:
        raise ValueError(f"deadband: a {element.base} has no dead-band, only numbers have")
    if not math.isfinite(tag.deadband):
        raise ValueError("deadband: expected a finite number")
    return tag.deadband


def unknown_column(name: str, entry: Mapping[str, object], known: Sequence[str], hint: str) -> str:
    """Return the message about an unknown key of a register; ``hint`` is its end if no known key is similar."""
    if name in OF_SOURCES and "type" in entry:  # else it may be a part of a path
        return f'unknown key {name!r}; {name} is a key of a [[source]] with connector = "mqtt": write it there'
    return f"{unknown('key', name, known)}{'' if near(name, known) else hint}"


def _tag(key: str, given: object) -> _Tag:
    """Read the entry of one register; raise ValueError if it is wrong."""
    if isinstance(given, str):
        return _Tag(given)
    if isinstance(given, dict) and (others := given.keys() - set(_Tag.__struct_fields__)):
        other = min(others)
        hint = f'; write a path with a dot in quotes, "{shorten(printable(f"{key}.{other}"))}"'
        raise ValueError(unknown_column(other, given, _Tag.__struct_fields__, hint))
    try:
        return msgspec.convert(given, _Tag)
    except msgspec.ValidationError as error:
        if isinstance(given, dict) and _is_nested(given.get("initial")):
            raise ValueError(
                "initial: expected one flat list, in which the last index varies fastest, found nested lists"
            ) from None
        raise ValueError(explain(error, "", _Tag, given)) from None


def _is_nested(initial: object) -> bool:
    return isinstance(initial, list) and any(isinstance(value, list) for value in initial)


def _check_length(initial: str, shape: tuple[int, ...]) -> None:
    """Raise ValueError if there are more values than the array has elements."""
    if shape:
        runs = split_array(initial, (shape[0] + 1, *shape[1:]))
        if runs and runs[-1][0] + runs[-1][1] > math.prod(shape):
            raise ValueError(f"initial: expected at most {math.prod(shape)} values, found more")


def parse_type(text: str) -> tuple[ElementType, Dims]:
    """Return the element type and the array bounds; raise ValueError if the text is not a type."""
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
    if math.prod(shape_of(tuple(dims))) > MAX_ELEMENTS:
        raise ValueError(f"expected at most {MAX_ELEMENTS} elements")
    element = element_type(text.strip())
    if element is None and _PATH.search(text):
        raise ValueError(
            f"unknown type {shorten(text)!r}; if this table names registers of a data block, give it together with the "
            'block\'s source: layout = "cell.db" and tags = "names.toml"'
        )
    if element is None:
        remedy = did_you_mean(_meant(text)) or (
            f"valid: BOOL, INT, DINT, REAL, LREAL, STRING[20] and similar, and the structures {', '.join(CONTENTS)}"
        )
        raise ValueError(f"unknown type {text!r}; {remedy}")
    return element, tuple(dims)


def _meant(text: str) -> list[str]:
    """Return the type that a misspelled one resembles, if any.

    For a name with a size, such as INT32, there is none: INT is similar, but has another size.
    """
    name = text.strip().partition("[")[0]
    return near(name, _COMMON) if name.isalpha() and element_type(name) is None else []


def _align(element: ElementType) -> int:
    return min(element.size, _MAX_ALIGN) if element.size & element.size - 1 == 0 else element.align


def _literal(value: _Scalar | list[_Scalar], element: ElementType) -> str:
    """Return an initial value as an S7 literal; the text of a number or a time already is such a literal."""
    if isinstance(value, list):
        return f"[{', '.join(_literal(item, element) for item in value)}]"
    if isinstance(value, str):
        if element.base not in TEXTS:
            return value
        escaped = value.replace("$", "$$").replace("'", "$'")
        return f"{'W' + element.base.removeprefix('W') + '#' if element.base.startswith('W') else ''}'{escaped}'"
    if isinstance(value, int) and abs(value) >> 64:
        raise ValueError("initial: expected a number of at most 64 bits, found a larger one")
    return str(value).upper() if isinstance(value, bool) else repr(value)
