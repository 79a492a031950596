from __future__ import annotations

import codecs

import pytest

from shmio.errors import LayoutError
from shmio.layout.compiler import Compiled, Source, compile_sources

TEXT = 'DATA_BLOCK "Größe"\nSTRUCT\n "µ" : Int; // für É\nEND_STRUCT;\nEND_DATA_BLOCK\n'


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
def test_what_is_not_utf8_is_windows_with_a_warning(encoding: str) -> None:
    compiled = compile_bytes(TEXT.encode(encoding))
    assert compiled.layouts[0].registers[0].comment == "für É"
    (warning,) = compiled.warnings
    assert str(warning).startswith("x.db:1:15: warning: not UTF-8: read as Windows-1252")
    assert "save the file as UTF-8" in warning.message


def test_characters_that_only_windows_has() -> None:
    assert compile_bytes(TEXT.replace("É", "€ „x“").encode("cp1252")).layouts[0].registers[0].comment == "für € „x“"


def test_bytes_without_a_character_in_windows_are_kept() -> None:
    compiled = compile_bytes(b'DATA_BLOCK "b" STRUCT a : Int; // \xff \x81\nEND_STRUCT; END_DATA_BLOCK')
    assert compiled.layouts[0].registers[0].comment == "ÿ \x81"


@pytest.mark.parametrize("data", [codecs.BOM_UTF16_LE + b"a\0\n\0\x00\xdc", codecs.BOM_UTF16_BE + b"\0a\0\n\0"])
def test_a_mark_that_lies_names_the_place_and_the_remedy(data: bytes) -> None:
    with pytest.raises(LayoutError, match=r"^x\.db:2:1: error: expected UTF-16-.E, .* export the source again"):
        compile_bytes(data)


def test_a_utf8_mark_that_lies_is_windows() -> None:
    assert "read as Windows-1252" in compile_bytes(codecs.BOM_UTF8 + TEXT.encode("cp1252")).warnings[0].message
