"""Tag tables as CSV files and workbooks."""

from __future__ import annotations

import builtins
import io
import re
import zipfile
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from openpyxl import Workbook

from shmio.errors import LayoutError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout

HEADER = ["path", "type", "address", "unit", "comment", "scale", "initial", "deadband", "writable"]
ROWS: list[list[Any]] = [
    ["pump/Speed", "REAL", "holding 100 UINT", "1/s", "", "0.1 -4", 1.5, 0.5, True],
    ["pump/Name", "STRING[8]", "", "", 'said "hi", once', "", "it's", "", ""],
    ["pump/Mode", "INT", 7, "", "", "", 3, "", "no"],
]
TABLE = """
[registers."pump/Speed"]
type = "REAL"
address = "holding 100 UINT"
unit = "1/s"
scale = [0.1, -4]
initial = 1.5
deadband = 0.5
writable = true
[registers."pump/Name"]
type = "STRING[8]"
comment = 'said "hi", once'
initial = "it's"
[registers."pump/Mode"]
type = "INT"
address = "7"
initial = "3"
"""


def compiled(file: str, data: bytes) -> Layout:
    return compile_sources([Source(file, data)]).layouts[0]


def refusal(file: str, data: bytes) -> str:
    with pytest.raises(LayoutError) as error:
        compiled(file, data)
    return str(error.value)


def as_csv(rows: Sequence[Sequence[object]], delimiter: str = ",", decimal: str = ".") -> bytes:
    def cell(value: object) -> str:
        text = str(value).lower() if isinstance(value, bool) else str(value)
        text = text.replace(".", decimal) if isinstance(value, float) else text
        return '"' + text.replace('"', '""') + '"' if any(mark in text for mark in '",;\t\n') else text

    return "".join(delimiter.join(map(cell, row)) + "\r\n" for row in rows).encode()


def as_xlsx(rows: Sequence[Sequence[Any]], title: str = "tags") -> bytes:
    book = Workbook()
    book.active.title = "other"  # type: ignore[union-attr]
    sheet = book.create_sheet(title)
    for row in rows:
        sheet.append([None if cell == "" else cell for cell in row])
    if title != "tags":
        book.remove(book["other"])
    stream = io.BytesIO()
    book.save(stream)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("file", "data"),
    [
        ("tags.csv", as_csv([HEADER, *ROWS])),
        ("Tags.CSV", b"\xef\xbb\xbf" + as_csv([HEADER, *ROWS], ";", ",")),
        ("tags.csv", as_csv([[name.upper() for name in HEADER], [], *ROWS, [""] * 9], "\t")),
        ("tags.csv", as_csv([row[::-1] for row in [HEADER, *ROWS]])),
        ("tags.xlsx", as_xlsx([HEADER, *ROWS])),
        ("tags.xlsx", as_xlsx([HEADER, *ROWS], "Pumps")),
    ],
    ids=["commas", "semicolons", "tabs", "other order", "workbook", "other sheet"],  # a workbook has the time in it
)
def test_a_sheet_says_the_same_as_toml(file: str, data: bytes) -> None:
    assert compiled(file, data).registers == compiled("tags.toml", TABLE.encode()).registers
    assert compiled(file, data).name.lower() == "tags"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            [],
            (
                "1:1: error: the file is not a tag table: the first row must name the columns path and type, but "
                "has nothing"
            ),
        ),
        ([["Name", "Path", "Data Type"]], "must name the columns type, but has name, path, data type"),
        ([["path", "type", "adress"]], "unknown column 'adress'"),
        ([["path", "type", "path"]], "the header has the column path twice"),
        ([["path", "type"]], "there are no rows"),
        ([["path", "type"], ["a", ""]], "2:1: error: a: the type is missing"),
        ([["path", "type"], ["", "INT"]], "2:1: error: row: the path is missing"),
        ([["path", "type"], ["a", "INT"], ["a", "INT"]], "3:1: error: a: this path is given twice, first in row 2"),
        ([["path", "type"], ["a", "INT", "7"]], "2:1: error: a: the row has more cells than the header"),
        ([["path", "type"], ["a", "INT"], ["b", "INTEGER"]], "3:1: error: b: unknown type 'INTEGER'"),
        ([["path", "type", "scale"], ["a", "INT", "1,5"]], "2:1: error: a: scale: expected a number, found '1,5'"),
        ([["path", "type", "deadband"], ["a", "INT", "inf"]], "deadband: expected a number"),
        ([["path", "type", "writable"], ["a", "INT", "maybe"]], "writable: expected true or false, found 'maybe'"),
    ],
)
def test_a_fault_is_named_with_its_row(rows: list[list[str]], message: str) -> None:
    assert message in refusal("tags.csv", as_csv(rows))
    if rows:
        assert message.replace("'1,5'", "'1,5'") in refusal("tags.xlsx", as_xlsx(rows))


def test_a_row_after_a_cell_of_several_lines_has_its_own_line() -> None:
    data = b'path,type,comment\na,INT,"one\ntwo\nthree"\nb,NOPE,\n'
    assert refusal("tags.csv", data).startswith("tags.csv:5:1: error: b: ")


def test_other_encodings_are_named() -> None:
    assert "line 2 is not in UTF-8" in refusal("tags.csv", b"path,type,unit\na,REAL,\xb0C\n")


def test_a_workbook_without_its_library_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "openpyxl":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    assert "pip install 'shmio[xlsx]'" in refusal("tags.xlsx", b"")


def test_a_workbook_that_unpacks_to_very_much_is_refused() -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/workbook.xml", bytes(65 << 20))
    assert "unpacks to more than" in refusal("tags.xlsx", stream.getvalue())


@given(st.binary(max_size=300))
def test_any_bytes_are_a_table_or_refused(data: bytes) -> None:
    for file, head in (("tags.csv", b"path,type\n"), ("tags.xlsx", b""), ("tags.csv", b"")):
        try:
            compiled(file, head + data)
        except LayoutError:
            continue


WORKBOOK = as_xlsx([HEADER, *ROWS])  # of another length in each second, as it has a time


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_damaged_workbook_is_a_table_or_refused(changes: list[tuple[int, int]]) -> None:
    damaged = bytearray(WORKBOOK)
    for place, byte in changes:
        damaged[place % len(damaged)] = byte
    try:
        compiled("tags.xlsx", bytes(damaged))
    except LayoutError:
        return


@pytest.mark.parametrize(
    ("pattern", "absurd"), [('<row r="2"', '<row r="99999999999"'), ('ref="A1:[A-Z0-9]+"', 'ref="A1:XFD1048576"')]
)
def test_a_workbook_with_absurd_numbers_of_rows_is_read_within_bounds(pattern: str, absurd: str) -> None:
    with zipfile.ZipFile(io.BytesIO(WORKBOOK)) as opened:
        parts = {name: opened.read(name) for name in opened.namelist()}
    [sheet] = [name for name, content in parts.items() if b'<row r="2"' in content]
    changed, count = re.subn(pattern, absurd, parts[sheet].decode())
    assert count == 1
    with zipfile.ZipFile(stream := io.BytesIO(), "w") as made:
        for name, content in parts.items():
            made.writestr(name, changed if name == sheet else content)
    if "row" in pattern:
        assert "there are no rows" in refusal("tags.xlsx", stream.getvalue())
    else:
        assert compiled("tags.xlsx", stream.getvalue()) == compiled("tags.xlsx", WORKBOOK)
