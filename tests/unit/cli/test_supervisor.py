"""``shmio-supervisor``: what it prints, refuses and writes, without starting anything."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from shmio import control
from shmio.cli import target
from shmio.cli.instance.init import comment_out
from shmio.cli.supervisor import main
from shmio.config import load
from shmio.endpoints.mqtt.broker import program
from shmio.layout.model import Layout, Register
from shmio.local import status
from shmio.plan.prepare import prepare
from shmio.segment import Activity, BlockSpec, ProcessSpec, Quality, Report, Segment, instances

ROOT = Path(__file__).parents[3]
SEED = ROOT / "tests" / "golden" / "layout" / "db201-as-printed.db"

TYPE = 'TYPE "Axis"\nSTRUCT\na : Real;\nEND_STRUCT;\nEND_TYPE\n'

Edit = Callable[[str, str], None]


def unplaced(text: str) -> str:
    """Remove the line numbers from messages."""
    return re.sub(r"^(\w+\.toml):[0-9]+: ", r"\1: ", text, flags=re.MULTILINE)


def block(name: str, kind: str) -> str:
    """Return the source of a data block with one register of a type."""
    return f"DATA_BLOCK {name}\nSTRUCT\nx : {kind};\nEND_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cell"  # beside no other test's folder: init reads its neighbours
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def example(capsys: pytest.CaptureFixture[str]) -> Edit:
    """Write the A50 example without its web page to this folder. A call of the result replaces one text by another."""
    assert main(["init"]) == 0
    capsys.readouterr()
    file = Path("supervisor.toml")
    file.write_text(comment_out(file.read_text(), "web"))

    def edit(old: str, new: str) -> None:
        text = file.read_text()
        assert text.count(old) == 1
        file.write_text(text.replace(old, new))

    return edit


@pytest.mark.parametrize("options", [[], ["--demo"]])
def test_init_writes_the_example_of_the_repository(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", *options]) == 0
    names = ["supervisor.toml", "db201.db", "scene.toml"]
    assert capsys.readouterr().out.splitlines()[:3] == [f"wrote {name}" for name in names]
    for name in names:
        assert Path(name).read_bytes() == (ROOT / name).read_bytes()


def test_sections_of_the_example_whose_programs_are_missing_are_comments(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    found = importlib.util.find_spec
    missing = {"amqtt", "uvicorn"}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in missing else found(name))
    monkeypatch.setattr(program, "find_spec", importlib.util.find_spec)
    assert main(["init", "--demo"]) == 0
    broker, page = capsys.readouterr().out.splitlines()[3:5]
    assert "shmio[broker]" in broker
    assert "shmio[web]" in page
    config = load(Path("supervisor.toml"))
    assert (config.mqtt, config.web, config.instance.name) == (None, None, "a50")
    uncommented = re.sub("^# (?!The A50)", "", Path("supervisor.toml").read_text(), flags=re.MULTILINE)
    assert uncommented == (ROOT / "supervisor.toml").read_text()


def test_demo_takes_no_files(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", "--demo", "cell.db"]) == 1
    assert "no files" in capsys.readouterr().err
    assert not Path("supervisor.toml").exists()


def test_init_names_tag_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    with pytest.raises(SystemExit):
        main(["init", "-h"])
    usage = " ".join(capsys.readouterr().out.split())
    for command in ("shmio-layout import", "shmio-supervisor browse", "use-a-tag-list.md"):
        assert command in last
        assert command in usage


@pytest.mark.parametrize(
    ("given", "remedies"),
    [
        ("tags.toml", ['write layout = "tags.toml" and the connector of your device into a [[source]] of supervisor']),
        ("tags.csv", ['write layout = "tags.csv" and', "shmio-layout import tags.csv -o tags.toml makes"]),
        ("PLCTags.xlsx", ["shmio-layout import PLCTags.xlsx -o tags.toml makes"]),
        ("symbols.sdf", ["shmio-layout import symbols.sdf -o tags.toml makes"]),
        ("opc.tcp://plc:4840", ["shmio-supervisor browse opc.tcp://plc:4840 -o tags.toml writes"]),
    ],
)
@pytest.mark.parametrize("more", [[], ["cell.db"]])
def test_init_says_what_to_do_with_a_tag_list(
    given: str, remedies: list[str], more: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("cell.db").write_text(block("DB7", "Int"))
    assert main(["init", given, *more]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert [remedy for remedy in remedies if remedy not in error] == []
    assert not Path("supervisor.toml").exists()


@pytest.mark.parametrize("name", ["supervisor.toml", "db201.db"])
def test_init_never_overwrites(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path(name).write_text("mine")
    assert main(["init"]) == 1
    assert capsys.readouterr().err.startswith(f"{name} exists already")
    assert [entry.name for entry in Path().iterdir()] == [name]
    assert Path(name).read_text() == "mine"


def test_existing_configuration_is_the_only_reported_fault(capsys: pytest.CaptureFixture[str]) -> None:
    Path("supervisor.toml").write_text("mine")
    assert main(["init", str(SEED)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_init_does_not_write_through_a_dangling_link(capsys: pytest.CaptureFixture[str]) -> None:
    Path("supervisor.toml").symlink_to("elsewhere.toml")
    assert main(["init"]) == 1
    assert not Path("elsewhere.toml").exists()


BLOCK = """DATA_BLOCK "{name}"
{{ S7_Optimized_Access := '{optimized}' }}
VERSION : 0.1
   STRUCT
      a : Int;
   END_STRUCT;
BEGIN
END_DATA_BLOCK
"""


def test_init_chooses_no_block_that_its_connector_cannot_read(capsys: pytest.CaptureFixture[str]) -> None:
    fast, slow = BLOCK.format(name="Fast", optimized="TRUE"), BLOCK.format(name="Slow", optimized="FALSE")
    Path("both.scl").write_text(fast + slow)
    Path("fast.db").write_text(fast)
    assert main(["init", "-c", "both.toml", "both.scl"]) == 0
    assert "left out: Fast, because the connector s7 cannot read optimized access" in capsys.readouterr().err
    assert re.findall(r'block = "(.*?)"', Path("both.toml").read_text()) == ["Slow"]
    assert main(["init", "-c", "fast.toml", "fast.db"]) == 1
    told = capsys.readouterr().err
    assert told.startswith("Fast: the connector s7 cannot read data blocks with optimized access; switch off")
    assert not Path("fast.toml").exists()
    assert main(["init", "-c", "fast.toml", "fast.db", "--block", "Fast"]) == 0, "the user has chosen it"
    assert "optimized access" in capsys.readouterr().err
    assert main(["init", "-c", "emulated.toml", "fast.db", "--emulated"]) == 0


def test_init_from_the_files_of_the_java_version(capsys: pytest.CaptureFixture[str]) -> None:
    Path("plc.ini").write_text(
        "model=S7_1500\nhost=10.76.0.12\nport=102\nrack=0\nslot=1\npacketSize=96\ndbNumber=201\n"
    )
    Path("cell.db").write_bytes(SEED.read_bytes())
    assert main(["init", "plc.ini", "cell.db"]) == 0
    assert "cell.db:7:7: warning" in capsys.readouterr().err
    config = load(Path("supervisor.toml"))
    [source] = config.source
    assert (source.layout, source.properties, source.texts["host"]) == ("cell.db", "plc.ini", "10.76.0.12")
    assert main(["check"]) == 0
    output = capsys.readouterr().out
    assert "source cell at 10.76.0.12:102: DB201, 22 registers, 2180 bytes" in output
    assert "optimized access" in output
    assert output.count("has spaces") == 1, "names with the same warning share a line"
    assert "; likewise '" in output
    assert output.count("'Axs4 Pos'") == 1


def test_init_from_a_layout_alone_leaves_the_address_to_fill_in(capsys: pytest.CaptureFixture[str]) -> None:
    (folder := Path("blocks")).mkdir()
    (folder / "x.db").write_bytes((ROOT / "db201.db").read_bytes())
    assert main(["init", "blocks/x.db", "-c", "other.toml"]) == 0
    [source] = load(Path("other.toml")).source
    assert (source.layout, source.options) == ("blocks/x.db", {}), "an address must not be made up"
    assert "next: fill in host in other.toml, then shmio-supervisor check -c other.toml" in capsys.readouterr().out
    assert main(["check", "-c", "other.toml"]) == 1
    assert capsys.readouterr().err == 'other.toml:4: source[0].host: this key is needed (source "cell")\n'


@pytest.mark.parametrize("order", [["cell.db", "types.udt"], ["types.udt", "plc.ini", "cell.db"]])
def test_block_with_types_in_other_files(order: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("plc.ini").write_text("host=10.76.0.12\n")
    Path("types.udt").write_text(TYPE)
    Path("cell.db").write_text(block("DB7", '"Axis"'))
    assert main(["init", *order]) == 0
    [source] = load(Path("supervisor.toml")).source
    assert source.layout == [name for name in order if name != "plc.ini"]
    if source.properties is None:
        Path("supervisor.toml").write_text(Path("supervisor.toml").read_text().replace('# host = ""', 'host = "plc"'))
    capsys.readouterr()
    assert main(["check"]) == 0
    assert "DB7, 1 register, 4 bytes" in capsys.readouterr().out


def test_a_block_without_a_number_in_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    """By default, TIA Portal exports a source that has the name of the block but not its number."""
    Path("cell.db").write_text(block('"Cell"', "Int"))
    Path("plc.ini").write_text("host=10.76.0.12\ndbNumber=7\n")
    assert main(["init", "cell.db", "-c", "bare.toml"]) == 0
    assert "next: fill in host and dbNumber in bare.toml, then" in capsys.readouterr().out
    text = Path("bare.toml").read_text().replace('# host = ""', 'host = "plc"')
    Path("bare.toml").write_text(text)
    assert main(["check", "-c", "bare.toml"]) == 1
    assert "source[0].dbNumber: this key is needed, because the layout 'Cell' has no number" in capsys.readouterr().err
    Path("bare.toml").write_text(text.replace("# dbNumber =", "dbNumber = 7"))
    assert main(["check", "-c", "bare.toml"]) == 0
    assert main(["init", "plc.ini", "cell.db"]) == 0
    assert main(["check"]) == 0


@pytest.mark.parametrize(
    ("files", "number"),
    [
        (["cell.db"], 1),
        (["--block", "db7", "two.db"], 7),
        (["two.db", "plc.ini"], 9),
        (["cell.db", "plc.ini"], 9),
        (["--block", "DB9", "by.ini", "two.db"], 9),
    ],
)
def test_init_with_an_emulated_controller_is_complete(
    files: list[str], number: int, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("cell.db").write_text(block('"Cell"', "Int"))
    Path("two.db").write_text(block("DB7", "Int") + block("DB9", "DInt"))
    Path("plc.ini").write_text("host=10.76.0.12\nport=102\nslot=2\ndbNumber=9\n")
    Path("by.ini").write_text("host=10.76.0.12\n")
    assert main(["init", "--emulated", *files]) == 0
    assert "next: shmio-supervisor check, then" in capsys.readouterr().out
    assert main(["check"]) == 0
    assert "no faults found" in capsys.readouterr().out
    prepared = prepare(Path("supervisor.toml"))
    [source], [emulator] = prepared.config.source, prepared.config.emulator
    assert (source.options["dbNumber"], emulator.dbNumber, emulator.program) == (number, number, "idle")
    assert emulator.listen == f"127.0.0.1:{source.options['port']}"
    assert [one.layout for one in prepared.emulated["plc"]] == [prepared.layouts["cell"]]
    assert source.writable == ["**"]


def test_emulated_block_without_a_number_needs_dbnumber(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    Path("db201.db").write_text(Path("db201.db").read_text().replace("DATA_BLOCK DB201", 'DATA_BLOCK "Cell"'))
    example("port = 1102", "port = 1102\ndbNumber = 7")
    assert main(["check"]) == 1
    assert "emulator[0].dbNumber: this key is needed" in capsys.readouterr().err
    example('program = "a50"', 'program = "a50"\ndbNumber = 7')
    assert main(["check"]) == 0


def test_an_idle_emulator_plays_all_blocks_of_its_files(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    """Several sources can then read one emulator, each its own block."""
    Path("two.db").write_text(block("DB7", "Int") + Path("db201.db").read_text())
    example('layout = "db201.db"\nprogram = "a50"', 'layout = "two.db"')
    assert main(["check"]) == 0
    assert [layout.number for layout, _ in prepare(Path("supervisor.toml")).emulated["plc"]] == [7, 201]
    example('layout = "two.db"', 'layout = "two.db"\ndbNumber = 201')
    assert [layout.number for layout, _ in prepare(Path("supervisor.toml")).emulated["plc"]] == [201]
    example("dbNumber = 201", 'dbNumber = 201\nprogram = "a50"')
    assert main(["check"]) == 0
    example("dbNumber = 201\n", "")
    capsys.readouterr()
    assert main(["check"]) == 1
    assert (
        "emulator[0].layout: the files contain several data blocks (DB7, DB201); choose one with the key block"
        in capsys.readouterr().err
    )


def test_an_idle_emulator_needs_a_number_for_each_block(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    Path("two.db").write_text(Path("db201.db").read_text() + block('"Cell"', "Int"))
    example('layout = "db201.db"\nprogram = "a50"', 'layout = "two.db"')
    assert main(["check"]) == 1
    error = capsys.readouterr().err
    assert (
        "emulator[0].dbNumber: this key is needed, because the data block 'Cell' has no number in its name; " in error
    )
    assert 'block = "Cell" in this section, to serve only that block' in error
    example('layout = "two.db"', 'layout = "two.db"\nblock = "Cell"\ndbNumber = 9')
    assert main(["check"]) == 0


def test_init_proposes_an_unused_name(instance: str) -> None:
    """No running instance has the name, and no configuration in this folder or its neighbours has it."""
    file = Path("plants/new/supervisor.toml")
    for folder in (file.parent, Path("plants/old")):
        folder.mkdir(parents=True)
    Path("cell.db").write_text(block(f'"{instance}"', "Int"))
    Path("plants/spoilt.toml").write_text("[instance")
    Path("plants/new/odd.toml").write_text("instance = 3")

    def proposed() -> str:
        assert main(["init", "cell.db", "-c", str(file)]) == 0
        name = load(file).instance.name
        file.unlink()
        return name

    taken = instance
    for number, place in enumerate(("new/b.toml", "old/supervisor.toml", "c.toml"), 2):
        assert proposed() == taken
        Path("plants", place).write_text(f'[instance]\nname = "{taken}"\n')
        taken = f"{instance}-{number}"
    with Segment.create(taken, [], []) as segment:
        assert proposed() == f"{instance}-5"
        segment.unlink()


def test_init_of_the_example_notes_a_name_in_use(capsys: pytest.CaptureFixture[str]) -> None:
    Path("new").mkdir()
    assert main(["init"]) == 0
    assert main(["init", "-c", "new/supervisor.toml"]) == 0
    assert "has the name a50, too; to run both, give this one the name a50-" in capsys.readouterr().out


def test_init_chooses_the_block_with_the_number_in_the_properties(capsys: pytest.CaptureFixture[str]) -> None:
    Path("two.db").write_text(block('"One"', "Int") + block("DB7", "DInt"))
    Path("plc.ini").write_text("host=10.76.0.12\ndbNumber=7\n")
    assert main(["init", "two.db", "plc.ini"]) == 0
    assert load(Path("supervisor.toml")).source[0].block == "DB7"
    assert main(["check"]) == 0
    assert "DB7, 1 register, 4 bytes" in capsys.readouterr().out


def test_init_names_the_missing_keys_of_the_properties_file(capsys: pytest.CaptureFixture[str]) -> None:
    Path("cell.db").write_text(block('"Größe 1é"', "Int"))
    Path("plc.ini").write_text("slot=1\n")
    assert main(["init", "plc.ini", "cell.db"]) == 0
    assert "next: fill in host and dbNumber in plc.ini, then" in capsys.readouterr().out
    text = Path("supervisor.toml").read_text()
    assert 'name = "groesse-1e"' in text
    assert "# host" not in text
    with socket.create_server(("127.0.0.1", 0)) as plc:
        port = plc.getsockname()[1]
        Path("plc.ini").write_text(f"host=127.0.0.1\nport={port}\ndbNumber=7\n")
        assert main(["check"]) == 0
        assert "nothing listens" not in capsys.readouterr().out
    assert main(["check"]) == 0
    output = capsys.readouterr().out
    assert f"note: source cell reads 127.0.0.1:{port}, where nothing listens at present" in output
    assert output.endswith("no faults found\n")


SEVERAL = [
    block('"Grip left"', "Array[0..99] of Int"),
    block("DB9", "Array[0..199] of DInt"),
    block('"Model"', "Array[1..40] of Real"),
]


def test_init_of_several_blocks_makes_a_source_of_each(capsys: pytest.CaptureFixture[str]) -> None:
    timers = block('"Timers"', "TON_TIME")
    Path("all.db").write_text("".join(SEVERAL) + timers)
    assert main(["init", "all.db"]) == 0
    captured = capsys.readouterr()
    assert "left out: all.db:" in captured.err
    assert "TON_TIME" in captured.err
    assert "next: fill in host and dbNumber in supervisor.toml" in captured.out
    config = load(Path("supervisor.toml"))
    assert [(one.name, one.block) for one in config.source] == [
        ("grip-left", "Grip left"),
        ("db9", "DB9"),
        ("model-2", "Model"),
    ]
    text = Path("supervisor.toml").read_text()
    Path("supervisor.toml").write_text(
        text.replace('# host = ""', 'host = "plc"').replace("# dbNumber =", "dbNumber = 5")
    )
    assert main(["check"]) == 0
    assert "source db9 at plc:102: DB9, 1 register, 800 bytes" in capsys.readouterr().out


@pytest.mark.parametrize("numbered", [True, False])
def test_init_of_several_blocks_with_emulated_controllers(numbered: bool, capsys: pytest.CaptureFixture[str]) -> None:
    blocks = [block("DB7", "Array[0..99] of Int"), SEVERAL[1]] if numbered else SEVERAL
    Path("all.db").write_text("".join(blocks))
    assert main(["init", "--emulated", "all.db"]) == 0
    assert main(["check"]) == 0
    assert "no faults found" in capsys.readouterr().out
    emulators = prepare(Path("supervisor.toml")).emulated
    assert [len(served) for served in emulators.values()] == ([2] if numbered else [1, 1, 1])


@pytest.mark.parametrize("choice", [["--block", "nope"], []])
def test_init_asks_which_of_many_blocks(choice: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("all.db").write_text("".join(block(f"DB{number}", "Int") for number in range(1, 61)))
    assert main(["init", "all.db", *choice]) == 1
    wanted = r"--block: unknown data block 'nope'" if choice else "choose one by --block"
    assert re.search(wanted, capsys.readouterr().err)
    assert main(["init", "all.db", "--block", "db44"]) == 0
    assert [source.block for source in load(Path("supervisor.toml")).source] == ["DB44"]


@pytest.mark.parametrize("name", ["cell.xml", "cell.db", "plc.ini"])
def test_init_refuses_xml_with_a_remedy(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path(name).write_text('<?xml version="1.0"?>\n<Document></Document>\n')
    Path("good.db").write_text(block("DB1", "Int"))
    assert main(["init", name, "good.db"]) == 1
    error = capsys.readouterr().err
    assert "this is XML, not the source of a data block" in error
    assert error.count("\n") == 1


def test_faults_of_other_blocks_are_ignored(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    both = Path("db201.db").read_text() + block('"Timers"', "TON_TIME")
    Path("db201.db").write_text(both)
    example('layout = "db201.db"\nhost', 'layout = "db201.db"\nblock = "DB201"\nhost')
    example('layout = "db201.db"\nprogram', 'layout = "db201.db"\ndbNumber = 201\nprogram')
    assert main(["check"]) == 0
    assert ": DB201, 22 registers, 2180 bytes" in capsys.readouterr().out
    example('block = "DB201"\n', 'block = "Timers"\n')
    assert main(["check"]) == 1
    assert "shmio does not know the members of the system type TON_TIME" in capsys.readouterr().err
    example('block = "Timers"\n', 'block = "Timers"\ndbNumber = 5\ntype_bytes = { TON_TIME = 16, Nope = 2 }\n')
    example('writable = ["Outputs", "Robot_*/*"]', "")
    assert main(["check"]) == 0
    out = capsys.readouterr().out
    assert "Timers, 1 register, 16 bytes" in out
    assert "source[0].type_bytes: no member in Timers has the type 'Nope'" in out
    example("TON_TIME = 16", "TON_TIME = 0")
    assert main(["check"]) == 1
    assert "source[0].type_bytes" in capsys.readouterr().err


@pytest.mark.parametrize("files", [["plc.ini"], ["a.db", "b.db"], ["plc.ini", "x.ini", "a.db"], ["no.db"]])
def test_init_refuses_unsuitable_files(files: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", *files]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not Path("supervisor.toml").exists()


def test_warnings_are_shown_with_faults(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    example('"Outputs", ', '"Nothing", ')
    example('kind = "s7"', 'kind = "s8"')
    assert main(["check"]) == 1
    fault, warning = capsys.readouterr().err.splitlines()
    assert "emulator[0].kind: unknown kind 's8'" in fault
    line = 1 + [text.startswith("writable") for text in Path("supervisor.toml").read_text().splitlines()].index(True)
    assert warning == f"supervisor.toml:{line}: warning: source[0].writable: 'Nothing' matches no register of DB201"


def test_check_prints_processes_sources_and_sizes(
    example: Edit, instance: str, capsys: pytest.CaptureFixture[str]
) -> None:
    example('name = "a50"', f'name = "{instance}"')
    assert main(["check"]) == 0
    output = capsys.readouterr().out
    assert f"supervisor.toml: instance {instance}, 6 processes" in output
    assert "source cell at 127.0.0.1:1102: DB201, 22 registers, 2180 bytes; ring of 512 frames, 10.2 s" in output
    assert re.search(rf"segment shmio-{instance}: \d\.\d\d MB", output)
    assert output.endswith("no faults found\n")
    assert instance not in instances()


def test_check_says_what_is_read_and_written(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check"]) == 0
    output = capsys.readouterr().out
    assert "\n    reads bytes 0 to 2179 of DB201:\n" in output
    first = "with a PDU of 240 bytes in 10 requests a cycle, one after the other; 20 ms need a round trip below 2 ms\n"
    assert first in output
    assert "\n    writable: 19 registers: Outputs, Robot_*/*\n" in output


def test_check_says_whether_a_period_can_be_met(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--round-trip-ms", "4"]) == 0
    output = capsys.readouterr().out
    assert "5 requests a cycle, one after the other: at least 20 ms; the period of 20 ms cannot be met\n" in output
    assert "3 requests a cycle, one after the other: at least 12 ms; the period of 20 ms can be met\n" in output
    assert "warning" not in output, "it depends on the controller"
    assert main(["check", "--json", "--round-trip-ms", "7"]) == 0, "a warning is no fault"
    found = json.loads(capsys.readouterr().out)
    cases = found["sources"][0]["requests"]
    assert [(one["cycle_ms"], one["met"]) for one in cases] == [(70, False), (35, False), (21, False)]
    [warning] = found["warnings"]
    assert warning == (
        "supervisor.toml:12: warning: source[0].period_ms: 20 ms cannot be met with a round trip of 7 ms, with one "
        "request at a time: a cycle takes at least 21 ms; raise period_ms above it, or read less"
    )
    example("period_ms = 20", "period_ms = 25")
    assert main(["check", "--round-trip-ms", "7"]) == 0
    assert capsys.readouterr().out.endswith("no faults found\n")


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "fast", "1e9"])
def test_check_refuses_what_is_no_round_trip(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["check", f"--round-trip-ms={text}"])
    assert ended.value.code == 2
    assert f"{text!r} is not a number of milliseconds above 0" in capsys.readouterr().err


def test_check_says_that_a_server_sends_values(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("tags.toml").write_text('[registers]\n"v" = { type = "REAL", address = "ns=2;i=1", writable = true }\n')
    source = '[[source]]\nname = "cell"\nconnector = "opcua"\nurl = "opc.tcp://server"\nlayout = "tags.toml"\n'
    Path("supervisor.toml").write_text(f'[instance]\nname = "x"\n{source}')
    assert main(["check", "--round-trip-ms", "1000"]) == 0
    output = capsys.readouterr().out
    assert "    reads 1 node, without requests in each cycle: the server sends what has changed, at most" in output
    assert "    writable: 1 register: v\n" in output
    assert output.endswith("no faults found\n")


def test_check_points_out_a_source_that_misses_its_emulator(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    example("port = 1102", "port = 1103")
    assert main(["check"]) == 0
    said = (
        "source[0]: it reads 127.0.0.1:1103, where no [[emulator]] of this file listens: plc listens on 127.0.0.1:1102"
    )
    assert said in capsys.readouterr().out
    example('host = "127.0.0.1" ', 'host = "10.76.0.12" ')
    assert main(["check"]) == 0
    assert "where no [[emulator]]" not in capsys.readouterr().out, "the source reads a real controller"


def test_check_as_json(example: Edit, instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    example('name = "a50"', f'name = "{instance}"')
    example("writable = [", 'writable = ["Outpts", ')
    assert main(["check", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found.pop("segment_bytes") > 1_000_000
    [source] = found.pop("sources")
    assert source.pop("ring_bytes") > 1_000_000
    assert source.pop("ring_s") == pytest.approx(10.24)
    by_pdu_size = source.pop("requests")
    assert "one request at a time" in source.pop("load_note")
    assert source == {
        "source": "cell", "peer": "127.0.0.1:1102", "block": "DB201", "registers": 22, "bytes": 2180,
        "ring_frames": 512, "period_ms": 20.0, "reads": "bytes 0 to 2179 of DB201",
        "writable": ["Outpts", "Outputs", "Robot_*/*"], "can_write": True, "writable_registers": 19,
    }  # fmt: skip
    assert [one["requests"] for one in by_pdu_size] == [10, 5, 3]
    assert by_pdu_size[0] == {
        "assumption": "PDU of 240 bytes", "requests": 10, "in_flight": 1, "round_trip_limit_ms": 2.0, "cycle_ms": None,
        "met": None,
    }  # fmt: skip
    [warning] = found.pop("warnings")
    assert "'Outpts' matches no register" in warning
    found.pop("notes")  # they depend on the host: its users and the ports in use
    assert found == {
        "config": "supervisor.toml", "instance": instance, "injections": [], "replay": [], "alerts": [],
        "processes": ["plc", "cell", "grpc", "broker", "mqtt", "recorder"], "segment": f"shmio-{instance}",
    }  # fmt: skip
    example("period_ms = 20", "period_ms = -1")
    assert main(["check", "--json"]) == 1
    out, err = capsys.readouterr()
    assert "period_ms" in err
    assert json.loads(out) == {"error": err.rstrip("\n")}


def test_check_reports_a_priority_that_is_not_allowed(
    example: Edit, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    example('kind = "s7"', 'kind = "s7"\nrealtime_priority = 10')
    assert main(["check"]) == 1
    assert "emulator[0].realtime_priority: this user may not have 10 (Operation not permitted); allow it" in (
        capsys.readouterr().err
    )


TAKEN = "has the same port as emulator[0].listen (127.0.0.1:1102); choose another port"


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("port = 1102", "prot = 1102", "source[0].prot: unknown key; did you mean 'port'?"),
        ("port = 1102", 'port = "eleven"', "source[0].port: expected a whole number, found 'eleven'"),
        ("port = 1102", 'port = "1102"', "source[0].port: expected a whole number, found '1102'"),
        ('host = "127.0.0.1"', 'host = "127.0.0.1:1102"', "source[0].host: '127.0.0.1:1102' is not a host name"),
        ('host = "127.0.0.1"  ', "# ", 'source[0].host: this key is needed (source "cell")\n'),
        ("port = 1102", 'model = "S7_2000"', "source[0].model: unknown model 'S7_2000'; did you mean 'S7_1200'?"),
        ("period_ms = 20", "options = {}", "source[0].options: unknown key"),
        ('program = "a50"', 'program = "a50"\nblock = "b"', "emulator[0].block: unknown data block 'b'; valid: DB201"),
        ('connector = "s7"', 'connector = "s7"\nstale_ms = 20', "source[0].stale_ms: 20 is less than two periods"),
        ('connector = "s7"', 'connector = "s7"\nrealtime_priority = 100', "source[0].realtime_priority: expected "),
        ('name = "a50"', 'name = "a50"\ngroup = "no such"', "instance.group: this host has no group 'no such'"),
        ('name = "a50"', 'name = "a50"\nlog_dir = "db201.db"', "instance.log_dir: "),
        ('name = "a50"', 'name = "a50"\nlog_dir = "db201.db/logs"', "instance.log_dir: "),
        ('directory = "dumps"', 'directory = "db201.db"', "recorder.directory: "),
        (
            'directory = "dumps"',
            'directory = "/proc/dumps"',
            "recorder.directory: /proc/dumps cannot be created",
        ),
        ('directory = "dumps"', f'directory = "{"x" * 300}"', "recorder.directory: "),
        ("[grpc]", '[grpc]\ntls = {certificate = "db201.db", key = "k"}', "grpc.tls.key: "),
        ("[grpc]", '[grpc]\ntls = {certificate = "db201.db", key = "db201.db"}', "grpc.tls.certificate: "),
        ('connector = "s7"', 'connector = "s8"', "source[0].connector: unknown connector 's8'; valid: "),
        ('kind = "s7"', 'kind = "s8"', "emulator[0].kind: unknown kind 's8'; valid: s7"),
        ('program = "a50"', 'program = "a51"', "emulator[0].program: unknown program 'a51'; did you mean 'a50'?"),
        ('"127.0.0.1:8090"', '"127.0.0.1:1102"', f"grpc.listen[1]: 127.0.0.1:1102 {TAKEN}"),
        ("[recorder]", '[web]\nlisten = "127.0.0.1:1102"\n[recorder]', f"web.listen: 127.0.0.1:1102 {TAKEN}"),
        ("[recorder]", '[metrics]\nlisten = "127.0.0.1:1102"\n[recorder]', f"metrics.listen: 127.0.0.1:1102 {TAKEN}"),
        ('"127.0.0.1:8090"', '"localhost:1102"', f"grpc.listen[1]: localhost:1102 {TAKEN}"),
        ('"127.0.0.1:8090"]', '"0.0.0.0:1102"]\ninsecure = true', f"grpc.listen[1]: 0.0.0.0:1102 {TAKEN}"),
        ('"127.0.0.1:8090"]', '"[::]:1102"]\ninsecure = true', f"grpc.listen[1]: [::]:1102 {TAKEN}"),
        (
            '"127.0.0.1:8090"]',
            '"[::ffff:127.0.0.1]:1102"]\ninsecure = true',
            "grpc.listen[1]: [::ffff:127.0.0.1]:1102 has the same port",
        ),
        (
            '"127.0.0.1:8090"]',
            '"a..b:1103"]\ninsecure = true',
            "grpc.listen[1]: a..b:1103: 'a..b' cannot be resolved (this",
        ),
        (
            '"127.0.0.1:8090"]',
            '"no.invalid:1103"]\ninsecure = true',
            "grpc.listen[1]: no.invalid:1103: 'no.invalid' can",
        ),
        ('"Outputs", ', '"a//b", ', "source[0].writable: "),
        ("period_ms = 20", "period_ms = 20\nproperties = 'none.ini'", "source[0].properties: "),
    ],
)
def test_faults_are_reported_by_check_and_up(
    example: Edit, old: str, new: str, error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    example(old, new)
    for verb in ("check", "up"):
        assert main([verb]) == 1
        output = capsys.readouterr()
        assert unplaced(output.err).startswith(f"supervisor.toml: {error}")
        assert output.err.count("\n") == 1


def test_up_detach_reports_faults(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    example("period_ms = 20", "perid_ms = 20")
    assert main(["up", "--detach"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("supervisor.toml:12: source[0].perid_ms: unknown key")
    example("perid_ms", "period_ms")
    Path("supervisor.toml").rename("other.toml")
    assert main(["up", "--detach", "--mode", "replay", "-c", "other.toml"]) == 1
    assert capsys.readouterr().err.startswith("other.toml: replay.file: name the recording to play")


@pytest.mark.parametrize("address", ["127.0.0.2:1102", "[::1]:1102", "localhost:0"])
def test_other_addresses_may_have_the_same_port(
    example: Edit, address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    example('"127.0.0.1:8090"', f'"{address}"')
    assert main(["check"]) == 0, capsys.readouterr().err


def test_faults_of_a_layout_have_line_and_column(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    Path("db201.db").write_text("DATA_BLOCK x\nSTRUCT\na : Reel;\nEND_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n")
    assert main(["check"]) == 1
    assert re.search(r"db201\.db:3:\d+: error: ", capsys.readouterr().err)
    Path("db201.db").unlink()
    assert main(["check"]) == 1
    assert "db201.db: No such file or directory" in capsys.readouterr().err
    os.mkfifo("db201.db")
    assert main(["check"]) == 1
    assert "db201.db: not a regular file; name the file of a data block" in capsys.readouterr().err


WRITABLE = '"Outputs"', '"{}"', "source[0].writable: '{}' matches no register of "
NONFINITE = "period_ms = 20", 'period_ms = 20\nallow_nonfinite = ["{}"]'
UNKNOWN_NAME = *NONFINITE, "source[0].allow_nonfinite: '{}' matches no register of "
OTHER_TYPE = *NONFINITE, "source[0].allow_nonfinite: '{}' matches no REAL or LREAL of DB201"
RECORDED = (
    'directory = "dumps"',
    'directory = "dumps"\nregisters = ["{}"]',
    "recorder.registers: {}: no register has this path",
)


@pytest.mark.parametrize(
    ("key", "pattern", "warned"),
    [
        (WRITABLE, "Outpts", True),
        (WRITABLE, "Robot_9*/*", True),
        (WRITABLE, "Outputs/5", False),
        (WRITABLE, "Inputs/*", False),
        (WRITABLE, "Robot_800", False),
        (UNKNOWN_NAME, "Robot_80/Axs1_Pos", True),
        (OTHER_TYPE, "Outputs", True),
        (OTHER_TYPE, "Inputs/5", True),
        (OTHER_TYPE, "Robot_800/Axs1_Pos", False),
        (OTHER_TYPE, "**", False),
        (RECORDED, "cell/Robot_9/**", True),
        (RECORDED, "cel/Inputs", True),
        (RECORDED, "cell/Robot_*/Axs1_Pos", False),
        (RECORDED, "cell/Inputs/5", False),
    ],
)
def test_pattern_without_a_match_is_a_warning(
    example: Edit, key: tuple[str, str, str], pattern: str, warned: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new, warning = key
    example(old, new.format(pattern))
    assert main(["check"]) == 0
    output = capsys.readouterr().out
    assert (f"warning: {warning.format(pattern)}" in output) is warned
    assert ("usable, with 1 warning\n" in output) is warned


def test_all_invalid_patterns_are_reported_together(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    example('"Outputs"', '"Inputs.%X0", "NCAchse1_Pos.%X0"')
    assert main(["check"]) == 1
    told = capsys.readouterr().err.splitlines()
    assert ["Inputs.%X0" in told[0], "NCAchse1_Pos.%X0" in told[1], len(told)] == [True, True, 2]


@pytest.mark.parametrize(("roles", "warned"), [('["read", "write"]', True), ('["read"]', False)])
def test_broker_that_lets_everybody_write_is_a_warning(
    example: Edit,
    roles: str,
    warned: bool,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", sys.executable)  # any program will do
    (folder / "accounts").write_text("anna:secret\n")
    (folder / "accounts").chmod(0o600)
    example('listen = "127.0.0.1:1883"', 'listen = "0.0.0.0:1883"\ninsecure = true\npassword_file = "accounts"')
    example('roles = ["read", "write"]', f"roles = {roles}")
    assert main(["check"]) == 0
    output = capsys.readouterr().out
    assert ("anyone who reaches 0.0.0.0:1883 may publish commands without an account" in output) is warned
    assert "mqtt.password_file: anna may only read" in output


def test_a_broker_for_other_hosts_needs_mosquitto(
    example: Edit, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    example('listen = "127.0.0.1:1883"', 'listen = "0.0.0.0:1883"\ninsecure = true')
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    for verb in ("check", "up"):
        assert main([verb]) == 1
        error = capsys.readouterr().err
        assert "mqtt.listen: other hosts can reach 0.0.0.0:1883" in error
        assert "needs mosquitto" in error


@pytest.mark.parametrize("key", ["dbNumber = 7", 'block = "db7"'])
def test_a_block_is_chosen_by_its_number_or_name(example: Edit, key: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("two.db").write_text(Path("db201.db").read_text() + block("DB7", "Int"))
    example('layout = "db201.db"\nhost', 'layout = "two.db"\nhost')
    assert main(["check"]) == 1
    error = capsys.readouterr().err
    assert (
        "source[0].layout: the files contain several data blocks (DB201, DB7); choose one with the key block or "
        "dbNumber" in error
    )
    example("port = 1102", f"port = 1102\n{key}")
    example('writable = ["Outputs", "Robot_*/*"]', "")
    assert main(["check"]) == 0
    assert ": DB7, 1 register, 2 bytes" in capsys.readouterr().out


def test_help_lists_the_arguments_of_init_and_the_modes(capsys: pytest.CaptureFixture[str]) -> None:
    for verb, said in (
        ("init", "init [-h] [-c FILE] [--demo | --emulated] [--block NAME] [plc.ini] [FILE.db [FILE.udt ...]]"),
        ("up", "replay: play a recording in place of the sources"),
    ):
        with pytest.raises(SystemExit):
            main([verb, "--help"])
        assert said in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--mode", "replay"], "replay.file: name the recording to play, by --from FILE.mem or "),
        (["--mode", "replay", "--from", "none.mem"], "replay.file: "),
        (["--mode", "replay", "--from", "db201.db"], "replay.file: "),
        (["--mode", "replay", "--from", "none.mem", "--speed", "0"], "replay.speed: expected a number >= 0.01"),
    ],
)
def test_impossible_replay_is_refused(
    example: Edit, options: list[str], error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["up", *options]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert unplaced(line).startswith(f"supervisor.toml: {error}")


def test_options_for_replay_are_refused_in_other_modes(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["up", "--paused"]) == 1
    assert capsys.readouterr().err == "--paused is only for --mode replay\n"


def test_log_mode_needs_a_recorder_section(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    Path("supervisor.toml").write_text(Path("supervisor.toml").read_text().partition("\n[recorder]")[0])
    assert main(["up", "--mode", "log"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "needs a [recorder] section; add one" in line


@pytest.mark.parametrize("arguments", [[], ["fly"], ["up", "--mode", "dead"], ["restart"], ["logs", "-n", "-1"]])
def test_wrong_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2


@pytest.mark.parametrize(
    ("verb", "said"),
    [
        (["down"], "no instance '{}' is running"),
        (["restart", "cell"], "no instance '{}' is running"),
        (["logs"], "no instance '{}' is running"),
        (["status"], "{}: stopped; it is not running"),
    ],
)
def test_verbs_report_that_no_instance_is_running(
    verb: list[str], said: str, instance: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*verb, "--instance", instance]) == 1
    error = capsys.readouterr().err
    assert said.format(instance) in error
    assert error.count("\n") == 1


def test_the_options_for_the_instance_may_come_before_the_verb(
    instance: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["--instance", instance, "status", "--json"], [f"--instance={instance}", "status", "--json"]):
        assert main(words) == 1
        assert json.loads(capsys.readouterr().out)["instance"] == instance
    assert main(["-c", f"{instance}.toml", "check"]) == 1
    assert f"{instance}.toml: No such file" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["-c", "list"])
    assert "required: VERB" in capsys.readouterr().err


def test_down_without_an_instance_does_not_suggest_up(instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["down", "--instance", instance]) == 1
    assert capsys.readouterr().err == f"no instance {instance!r} is running: nothing to stop\n"


@pytest.mark.parametrize("verb", [["down"], ["restart", "cell"], ["logs"]])
def test_silent_supervisor_is_reported(
    verb: list[str],
    instance: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(status, "SILENT_S", 0.0)
    monkeypatch.setattr(control, "TURN_S", 0.01)
    path = str(folder / "c.sock")
    with socket.socket(socket.AF_UNIX) as silent, Segment.create(instance, [], [], control=path) as segment:
        silent.bind(path)
        silent.listen()
        assert main([*verb, "--instance", instance]) == 1
        told = rf"supervisor pid {os.getpid()} has not responded for \d+ s"
        assert re.search(told, capsys.readouterr().err)
        segment.unlink()


def test_a_folder_is_no_configuration(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "-c", str(folder)]) == 1
    assert capsys.readouterr().err == f"{folder}: Is a directory; name the file, such as {folder}/supervisor.toml\n"


def test_output_to_a_full_disk_fails_in_one_line() -> None:
    command = [sys.executable, "-m", "shmio.cli.layout", str(ROOT / "db201.db")]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=60
        )
    assert (done.returncode, done.stderr) == (1, "shmio-layout: No space left on device\n")


@pytest.mark.parametrize(
    ("reason", "note", "shown"),
    [
        ("no answer", "no answer", "bad: no answer; cycle 3, - Hz, 1 overrun"),
        ("no answer", "no answer within", "bad: no answer; cycle 3, - Hz, 1 overrun"),
        ("no answer within", "no answer", "bad: no answer within; cycle 3, - Hz, 1 overrun"),
        ("no answer", "disk full", "bad: no answer; cycle 3, - Hz, 1 overrun; disk full"),
    ],
)
def test_status_prints_the_reason_once(
    instance: str, reason: str, note: str, shown: str, capsys: pytest.CaptureFixture[str]
) -> None:
    layout = Layout("DB1", 1, 2, False, (Register("a", "INT", (), 0, None, 2, 1),))
    blocks = [BlockSpec("cell", layout, 20_000_000, 3600 * 10**9, 1 << 16)]
    with Segment.create(instance, blocks, [ProcessSpec("cell", "source")]) as segment:
        worker = Segment.open(instance, writable=True)
        slot = worker.processes.find("cell")
        assert slot.take()
        slot.report = Report(os.getpid(), Activity.RUNNING, segment.header.started_ns, (7, 1), note)
        worker.writer("cell").publish(b"ab", cycle=3, quality=Quality.BAD, reason=reason)
        assert main(["status", "--instance", instance]) == 0
        assert capsys.readouterr().out.splitlines()[-1].endswith(f"  {shown}")
        worker.close()
        segment.unlink()


@pytest.mark.parametrize(("missed", "shown"), [(0, "0 s"), (1, "; 1 frame missed"), (7, "; 7 frames missed")])
def test_status_prints_how_many_frames_the_bridge_missed(
    instance: str, missed: int, shown: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with Segment.create(instance, [], [ProcessSpec("mqtt", "mqtt")]) as segment:
        worker = Segment.open(instance, writable=True)
        slot = worker.processes.find("mqtt")
        assert slot.take()
        note = "the broker is away" if missed else ""
        slot.report = Report(os.getpid(), Activity.RUNNING, segment.header.started_ns, (*7 * (0,), missed), note)
        assert main(["status", "--instance", instance]) == 0
        assert capsys.readouterr().out.splitlines()[-1].endswith(shown)
        worker.close()
        segment.unlink()


def test_status_of_a_stopped_instance_as_json(instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", "--json", "--instance", instance]) == 1
    output = capsys.readouterr()
    found = json.loads(output.out)
    assert (found["state"], found["processes"], found["instance"]) == ("stopped", [], instance)
    assert output.err == ""


def documented(page: str, heading: str) -> list[str]:
    """Return the names in the first column of the table that follows a line of the reference page."""
    table = page.partition(f"\n{heading}\n\n")[2].partition("\n\n")[0]
    return [name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split(" | ")[0])]


def test_status_has_the_documented_keys_in_order(instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    page = (ROOT / "docs/reference/cli-supervisor.md").read_text()
    layout = Layout("DB1", 1, 2, False, (Register("a", "INT", (), 0, None, 2, 1),))
    blocks = [BlockSpec("cell", layout, 20_000_000, 3600 * 10**9, 1 << 16)]
    kinds = {
        "source": "cell",
        "emulator": "plc",
        "grpc": "grpc",
        "fabric": "fabric",
        "opcua": "opcua",
        "mqtt": "mqtt",
        "recorder": "recorder",
        "web": "metrics",
        "alerts": "alerts",
    }
    with Segment.create(instance, blocks, [ProcessSpec(name, kind) for kind, name in kinds.items()]) as segment:
        assert main(["status", "--json", "--instance", instance]) == 0
        segment.unlink()
    told = json.loads(capsys.readouterr().out)
    assert list(told) == documented(page, "`status --json` prints one object, with all of these keys, in this order:")
    of_process, of_source = documented(page, "Each process has these keys:"), documented(page, "A source also has:")
    counters = page.partition("| kind | counters |\n")[2].partition("\n\n")[0].splitlines()[1:]
    for process, row in zip(told["processes"], counters, strict=True):
        kind, *names = re.findall(r"`(\w+)`", row)
        assert process["kind"] == kind
        assert list(process) == of_process + of_source * (kind == "source")
        assert list(process["counters"]) == names


class TestTarget:
    """The choice of the instance that a verb acts on."""

    def test_file_in_the_current_folder(self, example: Edit, instance: str, capsys: pytest.CaptureFixture[str]) -> None:
        example('name = "a50"', f'name = "{instance}"')
        assert main(["down"]) == 1
        assert f"no instance {instance!r} is running" in capsys.readouterr().err

    def test_faulty_file_still_names_its_instance(self, instance: str, capsys: pytest.CaptureFixture[str]) -> None:
        Path("spoilt.toml").write_text(f'wings = 2\n[instance]\nname = "{instance}"\nnmae = 3\n')
        assert main(["down", "-c", "spoilt.toml"]) == 1
        assert f"no instance {instance!r} is running" in capsys.readouterr().err

    @pytest.mark.parametrize("text", ["[instance", "[instance]\n", "instance = 3\n", '[instance]\nname = "../x"\n'])
    def test_a_file_without_a_name_is_refused(self, text: str, capsys: pytest.CaptureFixture[str]) -> None:
        Path("spoilt.toml").write_text(text)
        assert main(["down", "-c", "spoilt.toml"]) == 1
        assert capsys.readouterr().err.startswith("spoilt.toml: ")

    @pytest.mark.parametrize("name", ["../../etc/passwd", "", "a" * 41, "a b"])
    def test_invalid_name_is_refused(self, name: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["status", "--instance", name]) == 1
        assert "is not a name" in capsys.readouterr().err

    def test_only_running_instance_without_a_file(
        self, instance: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        running: list[str] = []
        monkeypatch.setattr(target, "running_instances", lambda: running)
        assert main(["status"]) == 1
        assert "no instance is running, and there is no supervisor.toml here" in capsys.readouterr().err
        running.append(instance)
        with Segment.create(instance, [], []) as segment:
            assert main(["status", "--json"]) == 0
            assert json.loads(capsys.readouterr().out)["instance"] == instance
            running.append("other")
            assert main(["status"]) == 1
            assert f"choose one by --instance ({instance}, other)" in capsys.readouterr().err
            segment.unlink()


def test_status_needs_no_heavy_imports() -> None:
    """``status`` must answer at once."""
    heavy = {"numpy", "grpc", "snap7", "asyncio", "shmio.local.attach"}
    code = (
        "import sys; from shmio.cli.supervisor import main; main(['status', '--json', '--instance', 'none-such']); "
        f"sys.exit(','.join({heavy!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""


@pytest.mark.parametrize("content", [b"", b"0123456789", bytes(8192)])
def test_down_removes_an_incomplete_segment(instance: str, content: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    left = Path(f"/dev/shm/shmio-{instance}")
    left.write_bytes(content)
    assert main(["down", "--instance", instance]) == 0
    assert f"removed the left-over segment shmio-{instance}" in capsys.readouterr().out
    assert not left.exists()


def test_hints_quote_the_configuration_for_the_shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "my plc.toml"
    file.write_text('[instance]\nname = "nobody-runs-this"\n')
    assert main(["status", "-c", str(file)]) == 1
    assert capsys.readouterr().err.endswith(f"start it with shmio-supervisor up -c '{file}'\n")
    assert main(["status", "--instance", "nobody-runs-this"]) == 1
    assert capsys.readouterr().err.endswith("start it with shmio-supervisor up -c FILE\n")


def test_check_warns_of_what_an_emulator_cannot_serve(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "my.db").write_text(block("DB7", "Int").replace("x : Int", "Enable : Int := NOWHERE"))
    (folder / "supervisor.toml").write_text(
        '[instance]\nname = "press"\n'
        '[[source]]\nname = "press"\nconnector = "s7"\nlayout = "my.db"\nhost = "127.0.0.1"\n'
        'port = 1102\ndbNumber = 7\nwritable = ["Enabel"]\n'
        '[[emulator]]\nname = "plc"\nkind = "s7"\nlayout = "my.db"\ndbNumber = 8\nlisten = "127.0.0.1:1102"\n'
    )
    assert main(["check"]) == 0
    out = capsys.readouterr().out
    assert "'Enabel' matches no register of DB7; did you mean 'Enable'?\n" in out
    assert "it reads DB7 of emulator 'plc', which serves only DB8\n" in out
    assert "the initial value NOWHERE of Enable cannot be read as INT; an emulated PLC starts it at 0\n" in out


INJECTION = """
[[injection]]
name = "one"
target = "cell/Outputs/100"
operation = "set"
value = 7

[grpc]
"""


def test_check_prints_declared_injections(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    example("[grpc]\n", INJECTION)
    assert main(["check"]) == 0
    assert "  injection one: set over source cell /out\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("Outputs/100", "Outputs/2000", "target: cell/Outputs: index [2000] is outside [0..1099]"),
        ("value = 7", "value = 256", "value: Outputs/100: BYTE: "),
        ("value = 7", 'value = 7\nwhen = "cell/Nothing > 1"', "when: cell/Nothing: DB201 has no such register"),
        ("value = 7", 'value = 7\nwhen = "cell/Inputs/1 >"', "when: at character 16: expected a register or a number"),
        ("value = 7", "value = 7\nfor = 1", "for: unknown key; did you mean 'for_s'?"),
        ("Outputs/100", "Outputs/100/in", "target: an injection toward a device needs `armed = true` in source 'cell'"),
    ],
)
def test_faults_of_declared_injections_are_named(
    example: Edit, old: str, new: str, error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    example("[grpc]\n", INJECTION)
    example(old, new)
    assert main(["check"]) == 1
    told = capsys.readouterr().err
    assert unplaced(told).startswith(f"supervisor.toml: injection[0].{error}"), told
    assert told.endswith('(injection "one")\n')


def test_injection_toward_the_device_needs_armed_and_writable(
    example: Edit, capsys: pytest.CaptureFixture[str]
) -> None:
    example("[grpc]\n", INJECTION)
    example("armed = false ", "armed = true ")
    example("Outputs/100", "Outputs/100/in")
    assert main(["check"]) == 0
    capsys.readouterr()
    example("Outputs/100", "Inputs/100")
    assert main(["check"]) == 1
    assert (
        "target: the injection is over /in, but cell/Inputs/100 is not writable; name it in the source's `writable`"
        in capsys.readouterr().err
    )


def test_number_of_declared_injections_is_bounded(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    tables = "".join(INJECTION.replace("one", f"n{place}").replace("[grpc]\n", "") for place in range(65))
    example("[grpc]\n", f"{tables}[grpc]\n")
    assert main(["check"]) == 1
    assert "injection: source 'cell' has 65 injections: at most 64 are allowed" in capsys.readouterr().err


def test_all_faults_are_reported_together(example: Edit, capsys: pytest.CaptureFixture[str]) -> None:
    Path("big.db").write_text(block('"Cell"', "Array[0..99] of Int") + block('"Timers"', "TON_TIME"))
    example('layout = "db201.db"\nhost = "127.0.0.1"', 'layout = "big.db"\nblock = "Cell"\n#')
    example("port = 1102", "port = 1102\nslott = 2")
    example('program = "a50"', 'program = "A50"')
    example("[mqtt]", '[[source]]\nname = "two"\nconnector = "S7"\nlayout = "none.db"\n[mqtt]')
    for verb in ("check", "up"):
        assert main([verb]) == 1
        err = capsys.readouterr().err.splitlines()
        assert [re.split("; did you|; valid", unplaced(line).removeprefix("supervisor.toml: "))[0] for line in err] == [
            'source[0].host: this key is needed (source "cell")',
            (
                "source[0].dbNumber: this key is needed, because the layout 'Cell' has no number in its name "
                '(source "cell")'
            ),
            "source[0].slott: unknown key",
            "emulator[0].program: unknown program 'A50'",
            "source[1].connector: unknown connector 'S7'",
            "warning: source[0].writable: 'Outputs' matches no register of Cell",
            "warning: source[0].writable: 'Robot_*/*' matches no register of Cell",
        ]
        assert all(re.match(r"supervisor\.toml:([0-9]+: | warning: )", line) for line in err)
    assert "did you mean 'a50'?" in err[3]
    assert "did you mean 's7'?" in err[4]


def test_faults_of_keys_connector_and_layout_are_reported_together(
    example: Edit, capsys: pytest.CaptureFixture[str]
) -> None:
    example("period_ms = 20", 'period_ms = "20"')
    example("port = 1102", 'port = "x"')
    example('layout = "db201.db"\nprogram', 'layout = "broken.db"\nprogram')
    Path("broken.db").write_text("DATA_BLOCK DB201 STRUCT a : Nope; b : Nope2; END_STRUCT; BEGIN END_DATA_BLOCK")
    assert main(["check"]) == 1
    err = capsys.readouterr().err.splitlines()
    assert [re.sub(r"^.*(supervisor\.toml|broken\.db):([0-9]+):", r"\2", line)[:40] for line in err] == [
        "11 source[0].port: expected a whole numb",
        "12 source[0].period_ms: expected a numbe",
        "129: error: unknown type 'Nope'; if it i",
        "139: error: unknown type 'Nope2'; if it ",
    ]
