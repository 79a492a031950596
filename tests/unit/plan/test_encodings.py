"""The encoding of a source's texts: as Siemens' tools have it, or as configured."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.errors import ConfigError
from shmio.layout.image import initial_frame
from shmio.layout.values.codec import codec
from shmio.plan.prepare import Prepared, prepare

BLOCK = """DATA_BLOCK "Kessel" { S7_Optimized_Access := 'FALSE' }
STRUCT
  Wert : String[8] := 'TEXT';
  Zahl : Int;
END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
TABLE = '[registers]\nText = { type = "STRING[8]", initial = "TEXT", address = "DB6.DBB0" }\n'


def source(name: str, connector: str, layout: str, more: str = "") -> str:
    address = 'host = "127.0.0.1"\nport = 1102\ndbNumber = 5\n' if layout.endswith("db") and connector == "s7" else ""
    address = address or ('host = "127.0.0.1"\n' if connector == "s7" else "")
    return f'[[source]]\nname = "{name}"\nconnector = "{connector}"\nlayout = "{layout}"\n{address}{more}'


def prepared(folder: Path, *sources: str) -> Prepared:
    file = folder / "supervisor.toml"
    file.write_text('[instance]\nname = "texts"\n' + "".join(sources))
    return prepare(file)


def test_encodings_of_sources_and_emulators(tmp_path: Path) -> None:
    """A block of Siemens' tools is Windows-1252, whoever reads it; a table is only if the connector is S7."""
    (tmp_path / "block.db").write_text(BLOCK.replace("TEXT", "20 €"))
    (tmp_path / "table.toml").write_text(TABLE.replace("TEXT", "20 €"))
    (tmp_path / "plain.toml").write_text('[registers]\nText = { type = "STRING[8]", initial = "üü" }\n')
    found = prepared(
        tmp_path,
        source("a", "s7", "block.db"),
        source("b", "memory", "block.db"),
        source("c", "s7", "table.toml"),
        source("d", "memory", "plain.toml"),
        source("e", "memory", "plain.toml", 'encoding = "UTF8"\n'),
        source("f", "s7", "block.db", 'encoding = "cp1250"\n'),
        '[[emulator]]\nname = "plc"\nkind = "s7"\nlayout = "table.toml"\nlisten = "127.0.0.1:1102"\n',
        'encoding = "gb18030"\n',
    )
    layouts = {**found.layouts, "plc": found.emulated["plc"][0].layout}
    for name, (encoding, data) in {
        "a": ("windows-1252", b"\x08\x0420 \x80"),
        "b": ("windows-1252", b"\x08\x0420 \x80"),
        "c": ("windows-1252", b"\x08\x0420 \x80"),
        "d": ("", b"\x08\x02\xfc\xfc"),
        "e": ("utf-8", b"\x08\x04\xc3\xbc\xc3\xbc"),
        "f": ("windows-1250", b"\x08\x0420 \x80"),
        "plc": ("gb18030", b"\x08\x0520 " + "€".encode("gb18030")),
    }.items():
        register = layouts[name].registers[0]
        assert register.encoding == encoding, name
        assert bytes(initial_frame(layouts[name])[0][: len(data)]) == data, name


def test_a_source_file_in_the_encoding_of_its_texts(tmp_path: Path) -> None:
    text = BLOCK.replace("Kessel", "锅炉").replace("TEXT", "温度")
    (tmp_path / "gbk.db").write_bytes(text.encode("gbk"))
    (tmp_path / "utf8.db").write_text(text, "utf-8")
    found = prepared(
        tmp_path,
        source("old", "s7", "gbk.db", 'encoding = "gbk"\n'),
        source("kept", "s7", "utf8.db", 'encoding = "gbk"\n'),  # in a repository, for example
    )
    for layout in found.layouts.values():
        frame, unread = initial_frame(layout)
        assert (layout.name, unread) == ("锅炉", ())
        assert frame[:6] == b"\x08\x04" + bytes.fromhex("ce c2 b6 c8")
        assert codec(layout.registers[0]).decode(frame) == "温度"


def test_wrong_encodings(tmp_path: Path) -> None:
    (tmp_path / "block.db").write_text(BLOCK)
    (tmp_path / "table.toml").write_text(TABLE.replace("TEXT", "20 €"))
    for sources, reason in {
        source(
            "a", "s7", "block.db", 'encoding = "windows-1259"\n'
        ): r"source\[0\].*encoding: unknown encoding 'windows-1259'",
        source("a", "s7", "block.db", 'encoding = "utf-16"\n'): r"source\[0\].*encoding: unknown encoding 'utf-16'",
        source("a", "s7", "table.toml", 'encoding = "iso-8859-1"\n'): (
            r"encoding: Text: initial: STRING\[8\]: the register's encoding \(iso-8859-1\) cannot hold '€', character 4"
        ),
        '[[source]]\nname = "a"\nconnector = "replay"\nfile = "x"\nencoding = "gbk"\n': "encoding: leave out this key",
    }.items():
        with pytest.raises(ConfigError, match=reason):
            prepared(tmp_path, sources)
