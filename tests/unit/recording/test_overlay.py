"""Recordings of a block with names over it."""

from __future__ import annotations

import json
from pathlib import Path

import mcap.reader
import pytest

from shmio.cli.dump import main
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.document import load_layout
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.model.statuses import GOOD, RegisterStatus, StatusArea
from shmio.recording.dump import open_dump
from shmio.recording.selection import RecordedRegisters, Selection
from shmio.segment import BlockSpec, Frame, ProcessSpec, Segment
from tests.unit.recorder.harness import read, recorder

BLOCK = b"""DATA_BLOCK DB1 { S7_Optimized_Access := 'FALSE' } STRUCT
  Other : Int; Inputs : Array[0..3] of Byte; Level : Real; END_STRUCT; BEGIN END_DATA_BLOCK"""
NAMES = b"""[registers]
Closed = "Inputs/1.%X3"
Word = { address = "Inputs/2", type = "WORD" }
Height = "Level"
"""
LAYOUT = compile_sources([Source("DB1.db", BLOCK), Source("names.toml", NAMES)]).layouts[0]
IMAGE = bytes.fromhex("1122 0008 abcd 3fc00000")


def recorded(instance: str, folder: Path, *registers: str) -> Path:
    blocks = [BlockSpec("cell", LAYOUT, 20_000_000, 60_000_000_000, 1 << 20)]
    with Segment.create(
        instance, blocks, [ProcessSpec("cell", "source"), ProcessSpec("recorder", "recorder")]
    ) as found:
        work = recorder(found, folder, selection=Selection(None, registers))
        found.writer("cell").publish(IMAGE, cycle=1)
        assert work.close()
        found.unlink()
    return work.output.path


def test_readers_find_the_names_and_older_ones_the_block(instance: str, tmp_path: Path) -> None:
    file = recorded(instance, tmp_path)
    with open_dump(file) as dump:
        found = {path: dump.columns(f"cell/{path}")[path].tolist() for path in ("Closed", "Word", "Height")}
        assert found == {"Closed": [True], "Word": [0xABCD], "Height": [1.5]}
        assert dump.blocks[0].layout == LAYOUT
    with file.open("rb") as stream:
        made = mcap.reader.make_reader(stream)
        attached = {one.name: one.data for one in made.iter_attachments()}
        summary = made.get_summary()
    assert summary is not None
    (about,) = [one.metadata for one in summary.channels.values() if one.topic == "cell/frames"]
    assert (about["layout"], about["names"]) == (LAYOUT.base.hash.hex(), LAYOUT.hash.hex())
    older = json.loads(attached[f"layouts/{about['layout']}.json"])
    assert [register["path"] for register in older["registers"]] == ["Other", "Inputs", "Level"]
    assert not any("over" in register for register in older["registers"])
    assert load_layout(attached[f"layouts/{about['names']}.json"]) == LAYOUT


@pytest.mark.parametrize(
    ("register", "kept", "paths"),
    [
        ("cell/Closed", "0000 0008 abcd 00000000", ["Inputs", "Closed"]),
        ("cell/Height", "0000 0000 0000 3fc00000", ["Level", "Height"]),
        ("cell/Level", "0000 0000 0000 3fc00000", ["Level"]),
    ],
)
def test_a_chosen_name_is_recorded_with_what_it_lies_over(
    instance: str, tmp_path: Path, register: str, kept: str, paths: list[str]
) -> None:
    file = recorded(instance, tmp_path, register)
    (frame,) = [message.item for message in read(file) if isinstance(message.item, Frame)]
    assert frame.raw == bytes.fromhex(kept)
    with open_dump(file) as dump:
        assert [one.path for one in dump.blocks[0].layout.registers] == paths


def test_cut_and_merge_keep_the_names(instance: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = recorded(instance, tmp_path)
    part, merged = str(tmp_path / "part.mem"), str(tmp_path / "merged.mem")
    assert main(["cut", str(file), "-o", part, "--only", "cell/Word"]) == 0
    assert main(["merge", part, "-o", merged]) == 0
    capsys.readouterr()
    for made in (part, merged):
        with open_dump(made) as dump:
            assert [one.path for one in dump.blocks[0].layout.registers] == ["Inputs", "Word"]
            assert dump.columns("cell/Word")["Word"].tolist() == [0xABCD]


def test_a_part_with_statuses_keeps_that_of_the_register_below(instance: str, tmp_path: Path) -> None:
    whole = LAYOUT.with_statuses()
    image = bytearray(IMAGE.ljust(whole.size, b"\0"))
    StatusArea(whole).put(image, whole.by_path["Inputs"], RegisterStatus(0x80050000, 5))
    part = RecordedRegisters(whole, [find(whole, path) for path in ("Inputs", "Word")])
    with open_dump(recorded(instance, tmp_path)) as dump:
        frame = next(iter(dump.frames("cell"))).item
    kept = part.keep(frame._replace(raw=bytes(image))).raw
    layout: Layout = load_layout(part.layout.to_json())
    area = StatusArea(layout)
    word = find(layout, "Word")
    assert (area.get(kept, area.index(word)).code, codec(word).decode(kept)) == (0x80050000, 0xABCD)
    assert area.get(bytes(len(kept)), 0).code == GOOD
