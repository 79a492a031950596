"""Compile tag tables: TOML files that name the registers of a source without a data block.

::

    name = "cell"                 # optional: the file's name
    [registers]
    "joints/R3200/Link1/R/position" = "LREAL"
    "joints/Kuka.j1/R" = { type = "LREAL", initial = 0.5, comment = "rad" }
    "lamps" = { type = "ARRAY[1..8] OF BOOL", initial = [true] }
    "safetyzones/Z1" = "SafetyZone"

Keys are paths as in topics. Types are those of S7, or structures of known shape, whose members
become registers. Values lie in the order of the file, each at a multiple of its size, in the byte
order ``byte_order`` (default: little, as on this machine); a single BOOL takes a byte of its own.
The initial values of an array are one list, in the order of its elements.
"""

from __future__ import annotations

import re
import tomllib
from contextlib import suppress
from functools import cached_property
from typing import Final

import msgspec

from shmio.config.lines import MAX_PARTS, too_long
from shmio.config.wording import explain, explain_toml
from shmio.errors import Diagnostic
from shmio.layout.model import Layout
from shmio.layout.placement.tag_place import Table, place_table
from shmio.layout.report import Report
from shmio.layout.source.lexer import MAX_SOURCE_BYTES
from shmio.layout.topic import shorten

SUFFIX: Final = ".toml"

_PLACE = re.compile(r" \(at (?:line ([0-9]+), column ([0-9]+)|end of document)\)")
_LONG_NUMBER = re.compile(r"[0-9_]{4300}")
_NAME = r"""("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*"""
_TABLE = r"registers[ \t]*\.[ \t]*"
_KEY = re.compile(rf"^[ \t]*(?:(?:{_TABLE})?{_NAME}[.=]|\[[ \t]*{_TABLE}{_NAME}[].])", re.MULTILINE)


def compile_tags(file: str, data: bytes, report: Report) -> Layout:
    """Compile one tag table; warnings stay in the report.

    Raises:
        LayoutError: The table is wrong; ``diagnostics`` has everything found.
    """
    table = _read(file, data, report)
    report.raise_errors()
    lines = _Lines(data.decode())
    return place_table(file, table, report, lines.line_of)


def _read(file: str, data: bytes, report: Report) -> Table:
    """Return the file's content; after an error report it and return an empty table."""
    if len(data) > MAX_SOURCE_BYTES:
        report.add(Diagnostic(file, 1, 1, f"the file is larger than {MAX_SOURCE_BYTES} bytes"))
        return Table({})
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        report.add(Diagnostic(file, data.count(b"\n", 0, error.start) + 1, 1, "it is not in UTF-8"))
        return Table({})
    if line := too_long(text, MAX_SOURCE_BYTES):
        what = f"a key has more than {MAX_PARTS} parts; write a path with dots in quotes"
        report.add(Diagnostic(file, line, 1, what))
        return Table({})
    try:
        return msgspec.convert(tomllib.loads(text), Table)
    except msgspec.ValidationError as error:
        report.add(Diagnostic(file, 1, 1, f"not a tag table: {explain(error)}"))
    except (ValueError, RecursionError) as error:
        report.add(_syntax_error(file, text, error))
    return Table({})


def _syntax_error(file: str, text: str, error: Exception) -> Diagnostic:
    """Return tomllib's error as a diagnostic with its place."""
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
        line -= 1  # tomllib gives the end of the value
    key = shorten(lines[line - 1].partition("=")[0].strip())
    return Diagnostic(file, line, 1, f"{key}: given twice; write a path with a dot in quotes")


class _Lines:
    """Finds the line of a key of a table on demand."""

    def __init__(self, text: str) -> None:
        self._text = text

    def line_of(self, key: str) -> int:
        """Return the last line on which a search finds the key, or 1."""
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
