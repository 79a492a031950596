"""Encodings of a source, and files of other kinds, which are refused in one line with a remedy."""

from __future__ import annotations

import codecs
import io
import zipfile

import pytest

from shmio.errors import LayoutError
from shmio.layout.compiler import Compiled, Source, compile_sources

TEXT = 'DATA_BLOCK "Größe"\nSTRUCT\n "µ" : Int; // für É\nEND_STRUCT;\nEND_DATA_BLOCK\n'
XML = '<?xml version="1.0" encoding="utf-8"?>\n<Document>\n  <SW.Blocks.GlobalDB ID="0"/>\n</Document>\n'
CSV = "Name,Path,Data Type,Logical Address,Comment\nStart,Default,Bool,%I0.0,go\nStop,Default,Bool,%I0.1,no\n"


def workbook() -> bytes:
    """Return the same bytes in each process of pytest-xdist: they are in the name of a test."""
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
        ("tags.sdf", b"x", "this is a table of tags"),
        ("tags.asc", b"126,%-24s%-12s%-10s\r\n" % (b"A", b"I 0.0", b"BOOL"), "this is a table of tags"),
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
def test_source_with_separators_is_no_table(text: str) -> None:
    for encoding in ("utf-8-sig", "utf-16"):
        assert compile_sources([Source("x.db", text.encode(encoding))]).layouts


def test_a_key_that_takes_long_to_read_is_refused_at_once() -> None:
    text = f'[registers]\na = "INT"\n{".".join("a" * 20_000)} = "INT"\n'
    with pytest.raises(LayoutError, match=r"t\.toml:3:1: error: a key has more than 64 parts"):
        compile_sources([Source("t.toml", text.encode())])


def compile_bytes(data: bytes) -> Compiled:
    return compile_sources([Source("x.db", data)])


@pytest.mark.parametrize(
    "data",
    [
        TEXT.encode(),
        codecs.BOM_UTF8 + TEXT.encode(),
        codecs.BOM_UTF16_LE + TEXT.encode("utf-16-le"),
        codecs.BOM_UTF16_BE + TEXT.replace("\n", "\r\n").encode("utf-16-be"),
    ],
    ids=["utf-8", "utf-8 with a mark", "utf-16-le", "utf-16-be"],
)
def test_unicode(data: bytes) -> None:
    compiled = compile_bytes(data)
    (layout,) = compiled.layouts
    (register,) = layout.registers
    assert (layout.name, register.path, register.comment) == ("Größe", "µ", "für É")
    assert not compiled.warnings


@pytest.mark.parametrize("encoding", ["cp1252", "latin-1"])
def test_other_encodings_are_read_as_windows_1252_with_a_warning(encoding: str) -> None:
    compiled = compile_bytes(TEXT.encode(encoding))
    assert compiled.layouts[0].registers[0].comment == "für É"
    (warning,) = compiled.warnings
    assert str(warning).startswith("x.db:1:15: warning: the file is not UTF-8, so shmio reads it as Windows-1252")
    assert "save it as UTF-8" in warning.message


def test_characters_that_only_windows_1252_has() -> None:
    assert compile_bytes(TEXT.replace("É", "€ „x“").encode("cp1252")).layouts[0].registers[0].comment == "für € „x“"


def test_bytes_without_a_character_in_windows_1252_are_kept() -> None:
    compiled = compile_bytes(b'DATA_BLOCK "b" STRUCT a : Int; // \xff \x81\nEND_STRUCT; END_DATA_BLOCK')
    assert compiled.layouts[0].registers[0].comment == "ÿ \x81"


@pytest.mark.parametrize("data", [codecs.BOM_UTF16_LE + b"a\0\n\0\x00\xdc", codecs.BOM_UTF16_BE + b"\0a\0\n\0"])
def test_wrong_utf16_byte_order_mark_is_refused_with_a_remedy(data: bytes) -> None:
    with pytest.raises(
        LayoutError, match=r"^x\.db:2:1: error: .* byte order mark of UTF-16-.E, .* export the source again"
    ):
        compile_bytes(data)


def test_wrong_utf8_byte_order_mark_is_read_as_windows_1252() -> None:
    assert "reads it as Windows-1252" in compile_bytes(codecs.BOM_UTF8 + TEXT.encode("cp1252")).warnings[0].message
