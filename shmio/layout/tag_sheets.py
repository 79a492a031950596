"""Read tag tables from CSV files and spreadsheets: a header row, then a row for each register.

The columns are ``path`` and ``type``, and any of ``address``, ``unit``, ``comment``, ``scale``,
``initial``, ``deadband``, ``writable``, ``word_order`` and ``byte_order``, in any order. A comma,
semicolon or tab separates the cells of a CSV file; with semicolons, numbers have a decimal comma.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from shmio.errors import Diagnostic
from shmio.layout.model import MAX_REGISTERS
from shmio.layout.report import Report
from shmio.layout.source.file import decode
from shmio.layout.topic import shorten
from shmio.layout.workbook import WorkbookError, read_rows
from shmio.wording import printable, unknown

SUFFIXES: Final = (".csv", ".xlsx")
_TEXTS: Final = ("type", "address", "unit", "comment", "word_order", "byte_order")
COLUMNS: Final = ("path", *_TEXTS[:4], "scale", "initial", "deadband", "writable", *_TEXTS[4:])
_BOOLS: Final = {"true": True, "yes": True, "1": True, "x": True, "false": False, "no": False, "0": False}
_NUMBER: Final = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")


class Sheet(NamedTuple):
    """The registers of a table by path, and the number of each register's row by path."""

    registers: Mapping[str, object]
    rows: Mapping[str, int]


def read_sheet(
    file: str, data: bytes, report: Report, needed: Sequence[str] = ("path", "type"), encoding: str = ""
) -> Sheet:
    """Return the registers of a table, and add its errors to the report; each row must fill the ``needed`` columns.

    ``encoding`` is that of a CSV file that is not in UTF-8.
    """
    try:
        rows, comma = _rows_of(file, data, encoding)
        return _sheet(file, rows, report, needed, decimal_comma=comma)
    except WorkbookError as error:
        report.add(Diagnostic(file, error.row, 1, f"the file is not a tag table: {error}"))
        return Sheet({}, {})
    except (ValueError, csv.Error) as error:
        report.add(Diagnostic(file, 1, 1, f"the file is not a tag table: {error}"))
        return Sheet({}, {})


def _rows_of(file: str, data: bytes, encoding: str) -> tuple[Iterable[tuple[int, Sequence[str]]], bool]:
    """Return the numbered rows, and whether numbers have a decimal comma; raise ValueError for a bad file."""
    if file.lower().endswith(".xlsx"):
        return read_rows(data, _sheet_of_tags), False
    decoded = decode(data, encoding)
    if decoded.problem:
        what = (
            f": {decoded.problem}"
            if encoding
            else " is not in UTF-8; save the file as 'CSV UTF-8', or name its encoding"
        )
        raise ValueError(f"line {decoded.line}{what}")
    text = decoded.text
    header = text.partition("\n")[0]
    delimiter = max(",;\t", key=header.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    return _numbered(reader), delimiter == ";"


def _numbered(reader: Iterator[list[str]]) -> Iterator[tuple[int, Sequence[str]]]:
    """Yield each row of a CSV file with the number of the line on which it begins."""
    line = 1
    for row in reader:
        yield line, row
        line = reader.line_num + 1  # type: ignore[attr-defined]  # csv's readers have it


def _sheet_of_tags(names: Sequence[str]) -> str | None:
    return next((name for name in names if name.lower() == "tags"), names[0] if names else None)


def _sheet(
    file: str,
    rows: Iterable[tuple[int, Sequence[str]]],
    report: Report,
    needed: Sequence[str],
    *,
    decimal_comma: bool,
) -> Sheet:
    """Convert rows to entries like those of a TOML table; raise ValueError if the header is wrong."""
    rows = iter(rows)
    _, header = next(rows, (1, ()))
    columns = _columns([cell.strip().lower() for cell in header], needed)
    registers: dict[str, object] = {}
    places: dict[str, int] = {}
    for number, row in rows:
        cells = {name: cell.strip() for name, cell in zip(columns, row, strict=False) if name and cell.strip()}
        if not cells:
            continue
        path = cells.pop("path", "")
        try:
            if any(cell.strip() for cell in row[len(columns) :]):
                raise ValueError("the row has more cells than the header")
            if not path:
                raise ValueError("the path is missing")
            if path in registers:
                raise ValueError(f"this path is given twice, first in row {places[path]}")
            if missing := [name for name in needed if name != "path" and name not in cells]:
                raise ValueError(f"the {missing[0]} is missing")
            registers[path] = _entry(cells, decimal_comma=decimal_comma)
            places[path] = number
        except ValueError as error:
            report.add(Diagnostic(file, number, 1, f"{shorten(printable(path)) or 'row'}: {error}"))
        if len(registers) > MAX_REGISTERS:
            raise ValueError(f"there are more than {MAX_REGISTERS} registers")
    if not registers and not report.errors:
        raise ValueError("there are no rows below the header")
    return Sheet(registers, places)


def _columns(header: Sequence[str], needed: Sequence[str]) -> list[str]:
    """Return the names of the columns; raise ValueError if one is missing, unknown or duplicate."""
    while header and not header[-1]:
        header = header[:-1]
    if missing := [name for name in needed if name not in header]:
        found = shorten(printable(", ".join(header))) or "nothing"
        raise ValueError(
            f"the first row must name the columns {' and '.join(missing)}, but has {found}; valid: {', '.join(COLUMNS)}"
        )
    for name in header:
        if name and name not in COLUMNS:
            raise ValueError(unknown("column", name, COLUMNS))
        if name and header.count(name) > 1:
            raise ValueError(f"the header has the column {name} twice; remove one of them")
    return list(header)


def _entry(cells: Mapping[str, str], *, decimal_comma: bool) -> dict[str, object]:
    """Return a row's cells as an entry like those of a TOML table; raise ValueError if a cell is wrong."""
    entry: dict[str, object] = {name: cells[name] for name in _TEXTS if name in cells}
    if "initial" in cells:
        real = cells.get("type", "").upper() in ("REAL", "LREAL")
        entry["initial"] = _with_point(cells["initial"], decimal_comma) if real else cells["initial"]
    if "scale" in cells:
        numbers = [_number("scale", part, decimal_comma) for part in re.split(r"[\s;]+", cells["scale"])]
        entry["scale"] = numbers[0] if len(numbers) == 1 else numbers
    if "deadband" in cells:
        entry["deadband"] = _number("deadband", cells["deadband"], decimal_comma)
    if "writable" in cells:
        found = _BOOLS.get(cells["writable"].lower())
        if found is None:
            raise ValueError(f"writable: expected true or false, found {shorten(printable(cells['writable']))!r}")
        entry["writable"] = found
    return entry


def _with_point(text: str, decimal_comma: bool) -> str:
    """Return a number with a decimal point instead of its decimal comma."""
    return text.replace(",", ".") if decimal_comma and text.count(",") == 1 and "." not in text else text


def _number(name: str, text: str, decimal_comma: bool) -> float:
    number = _with_point(text, decimal_comma)
    if not _NUMBER.fullmatch(number):
        raise ValueError(f"{name}: expected a number, found {shorten(printable(text))!r}")
    return float(number)
