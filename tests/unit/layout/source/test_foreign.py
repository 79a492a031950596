"""Files that are given for a source and are none: one line says what they are, and what to do."""

from __future__ import annotations

import io
import zipfile

import pytest

from shmio.errors import LayoutError
from shmio.layout.compiler import Source, compile_sources

XML = '<?xml version="1.0" encoding="utf-8"?>\n<Document>\n  <SW.Blocks.GlobalDB ID="0"/>\n</Document>\n'
CSV = "Name,Path,Data Type,Logical Address,Comment\nStart,Default,Bool,%I0.0,go\nStop,Default,Bool,%I0.1,no\n"


def workbook() -> bytes:
    """Always the same bytes: they are in the name of a test, which all processes of pytest-xdist must agree on."""
    with zipfile.ZipFile(buffer := io.BytesIO(), "w") as archive:
        archive.writestr(zipfile.ZipInfo("xl/workbook.xml"), "<workbook/>" * 1000)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "what"),
    [
        ("cell.db", XML.encode(), "this is XML"),
        ("cell.db", XML.encode("utf-8-sig"), "this is XML"),
        ("cell.db", XML.encode("utf-16"), "this is XML"),
        ("cell.xml", b"", "this is XML"),
        ("cell.db", CSV.encode(), "this is a table of tags"),
        ("cell.db", CSV.replace(",", ";").encode("utf-16"), "this is a table of tags"),
        ("cell.db", CSV.replace(",", "\t").encode("cp1252"), "this is a table of tags"),
        ("tags.csv", b"x", "this is a table of tags"),
        ("cell.db", workbook(), "this is a spreadsheet"),
        ("cell.db", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600), "this is a spreadsheet"),
        ("cell.db", bytes(range(256)) * 40 + bytes(4000), "this is not a text file"),
        ("cell.db", b"\x7fELF" + bytes(4000), "this is not a text file"),
    ],
)
def test_a_file_of_another_kind_is_one_fault_with_its_remedy(name: str, data: bytes, what: str) -> None:
    with pytest.raises(LayoutError) as caught:
        compile_sources([Source(name, data)])
    [found] = caught.value.diagnostics
    assert str(found).startswith(f"{name}:1:1: error: {what}")
    assert "'Generate source from blocks'" in found.message


@pytest.mark.parametrize(
    "text",
    [
        "// a;b;c\n// d;e;f\nDATA_BLOCK DB1 STRUCT a : Int; END_STRUCT; BEGIN END_DATA_BLOCK\n",
        "(* a, b, c\n d, e, f *)\nDATA_BLOCK DB1 STRUCT a,b,c : Int; END_STRUCT; BEGIN END_DATA_BLOCK\n",
    ],
)
def test_a_source_is_none_of_these(text: str) -> None:
    for encoding in ("utf-8-sig", "utf-16"):
        assert compile_sources([Source("x.db", text.encode(encoding))]).layouts


def test_a_key_that_takes_long_to_read_is_refused_at_once() -> None:
    text = f'[registers]\na = "INT"\n{".".join("a" * 20_000)} = "INT"\n'
    with pytest.raises(LayoutError, match=r"t\.toml:3:1: error: a key has more than 64 parts"):
        compile_sources([Source("t.toml", text.encode())])
