"""What the emulators of a configuration serve: their own layouts, or the layouts of the sources that read them."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.errors import ConfigError
from shmio.plan.prepare import Prepared, prepare

SOURCE = """
[[source]]
name = "NAME"
connector = "s7"
layout = "LAYOUT"
host = "127.0.0.1"
port = 1102
"""
EMULATOR = """
[[emulator]]
name = "plc"
kind = "s7"
listen = "127.0.0.1:1102"
"""
PRESS = """
[registers]
"Speed" = { type = "INT", address = "DB5.DBW4", writable = true }
"Lamp" = { type = "BOOL", address = "%Q1.2" }
"State" = { type = "STRING[9]", address = "cpu.state" }
"""
LINE = '[registers]\n"Count" = { type = "INT", address = "DB6.DBW0" }\n'
BLOCK = 'DATA_BLOCK "Cell" STRUCT a : Int; b : Int; END_STRUCT; BEGIN END_DATA_BLOCK'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "press.toml").write_text(PRESS)
    (tmp_path / "line.toml").write_text(LINE)
    (tmp_path / "cell.db").write_text(BLOCK)
    return tmp_path


def source(name: str, layout: str, more: str = "") -> str:
    return SOURCE.replace("NAME", name).replace("LAYOUT", layout) + more


def prepared(folder: Path, *parts: str) -> Prepared:
    file = folder / "supervisor.toml"
    file.write_text('[instance]\nname = "emulated"\n' + "".join(parts))
    return prepare(file)


def served(found: Prepared) -> list[tuple[str, int | None]]:
    return [(layout.name, layout.number) for layout, _ in found.emulated["plc"]]


def test_an_emulator_without_a_layout_serves_what_its_sources_read(folder: Path) -> None:
    found = prepared(
        folder,
        source("press", "press.toml"),
        source("twin", "press.toml", "period_ms = 100\n"),
        source("cell", "cell.db", "dbNumber = 7\n"),
        source("line", "line.toml"),
        source("elsewhere", "line.toml").replace("1102", "1103"),
        EMULATOR,
    )
    assert served(found) == [("Cell", 7), ("press", None), ("line", None)]
    assert all(layout.status_offset is None for layout, _ in found.emulated["plc"])
    assert len([text for text in found.plan.warnings if "emulator" in text]) == 1, found.plan.warnings
    assert "it reads 127.0.0.1:1103, where no [[emulator]]" in found.plan.warnings[0]


def test_an_emulator_with_a_table_of_its_own(folder: Path) -> None:
    found = prepared(
        folder, source("line", "line.toml"), source("press", "press.toml"), EMULATOR, 'layout = "press.toml"\n'
    )
    assert served(found) == [("press", None)]
    (warning,) = found.plan.warnings
    assert warning.endswith("line): it reads DB6 of emulator 'plc', which serves only %Q, DB5") or (
        "it reads DB6 of emulator 'plc', which serves only %Q, DB5" in warning
    )


def test_a_program_runs_on_the_only_table(folder: Path) -> None:
    found = prepared(folder, source("press", "press.toml"), EMULATOR, 'program = "wave"\n')
    assert served(found) == [("press", None)]


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        (("",), r"emulator\[0\].*layout: this key is needed, because no source with connector = .s7. reads 127.0.0.1:"),
        ((source("press", "press.toml"), "dbNumber"), r"emulator\[0\].*dbNumber: this key needs layout in the same"),
        (
            (source("press", "press.toml"), source("line", "line.toml"), "wave"),
            "layout: this key is needed: program wave runs on one of press, line",
        ),
        ((source("line", "line.toml"), "a50"), "program a50: "),
        ((source("line", "line.toml"), "profile"), r"\[0\].*unknown profile 's7-30'.*'s7-300'.*valid: .*im151-8"),
        ((source("cell", "cell.db", "dbNumber = 7\n"), "table"), "dbNumber: leave out this key, because each address"),
        (
            (source("cell", "cell.db", "dbNumber = 6\n"), source("line", "long.toml")),
            "needs 10 bytes of DB6, whose layout has 4",
        ),
    ],
)  # fmt: skip
def test_faults(folder: Path, parts: tuple[str, ...], reason: str) -> None:
    (folder / "long.toml").write_text(LINE.replace("DBW0", "DBW8"))
    *sources, last = parts
    end = {
        "dbNumber": "dbNumber = 5\n",
        "wave": 'program = "wave"\n',
        "a50": 'program = "a50"\n',
        "profile": 'profile = "s7-30"\n',
        "table": 'layout = "press.toml"\ndbNumber = 5\n',
    }.get(last)
    with pytest.raises(ConfigError, match=reason):
        prepared(folder, *(sources if end else parts), EMULATOR, end or "")


def test_a_faulty_source_is_the_only_fault(folder: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        prepared(folder, source("press", "press.toml", 'timeout = "long"\n'), EMULATOR)
    assert "timeout" in str(caught.value)
    assert "emulator" not in str(caught.value)


MODBUS = SOURCE.replace('"s7"', '"modbus"')
TABLE = """
[registers]
"a" = { type = "DINT", address = "holding 0", initial = 74 }
"b" = { type = "INT", address = "holding 2" }
"""


def test_an_emulator_with_a_layout_of_its_own_has_the_device_keys_of_its_sources(folder: Path) -> None:
    (folder / "plant.toml").write_text(TABLE)
    emulator = EMULATOR.replace('"s7"', '"modbus"') + 'layout = "plant.toml"\n'

    def read_by(*keys: str) -> list[dict[str, object]]:
        sources = [
            MODBUS.replace("NAME", f"m{at}").replace("LAYOUT", "plant.toml") + more for at, more in enumerate(keys)
        ]
        usual = {"unit": 1, "framing": "tcp", "word_order": "big", "byte_order": "big"}
        found = [dict(options) for _, options in prepared(folder, *sources, emulator).emulated["plc"]]
        return [{key: value for key, value in one.items() if value != usual[key]} for one in found]

    assert read_by() == [{}]
    assert read_by(
        'word_order = "little"\nframing = "rtu"\n', "max_gap = 3\nframing = 'rtu'\nword_order = 'little'"
    ) == [{"word_order": "little", "framing": "rtu"}]
    assert read_by('byte_order = "little"\n', "unit = 7\n") == [{"byte_order": "little"}, {"unit": 7}]
    for first, second, reason in (
        (
            'word_order = "little"\n',
            "",
            "layout: a: the sources that read this register of unit 1 differ in word_order",
        ),
        ('byte_order = "little"\n', "unit = 1\n", "layout: a: the sources that read this register of unit 1 differ"),
        ('framing = "rtu"\n', "", "framing: the sources of one device must have the same framing"),
    ):
        with pytest.raises(ConfigError, match=reason):
            read_by(first, second)


def test_an_emulator_of_a_block_of_its_own_has_the_nodes_that_a_source_reads(folder: Path) -> None:
    (folder / "tags.toml").write_text(LINE.replace("DB6.DBW0", "ns=2;s=count"))
    opcua = '[[source]]\nname = "NAME"\nconnector = "opcua"\nlayout = "LAYOUT"\nurl = "opc.tcp://127.0.0.1:1102/x"\n'
    found = prepared(
        folder,
        opcua.replace("NAME", "tags").replace("LAYOUT", "tags.toml"),
        opcua.replace("NAME", "cell").replace("LAYOUT", "cell.db") + 'nodes = "siemens"\n',
        EMULATOR.replace('"s7"', '"opcua"'),
        'layout = "cell.db"\n',
    )
    assert [dict(options) for _, options in found.emulated["plc"]] == [{"nodes": "siemens"}]
