"""``shmio-dump export``: files for other programs."""

from __future__ import annotations

import csv
import json
import math
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import shmio
from shmio.cli.dump import main
from shmio.cli.recordings.common import Progress
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import codec
from shmio.segment import Quality
from tests.unit.recording.build import PERIOD_NS, START_NS, build, image, varied

parquet: Any = pytest.importorskip("pyarrow.parquet")

KINDS = Layout("DB9", 9, 92, False, (
    Register("Robot/speed", "REAL", (), 0, None, 4, 1),
    Register("Robot/far", "LREAL", (), 4, None, 8, 1),
    Register("on", "BOOL", (), 12, 2, 1, 1),
    Register("bits", "BOOL", ((0, 3),), 13, 0, 1, 4),
    Register("word", "WORD", (), 14, None, 2, 1),
    Register("big", "ULINT", (), 16, None, 8, 1),
    Register("grid", "INT", ((0, 1), (1, 2)), 24, None, 8, 4),
    Register("name", "STRING[6]", (), 32, None, 8, 1),
    Register("for", "TIME", (), 40, None, 4, 1),
    Register("day", "DATE", (), 44, None, 2, 1),
    Register("when", "DTL", (), 46, None, 12, 1),
    Register("where", "POINTER", (), 58, None, 6, 1),
    Register("clock", "LTOD", (), 64, None, 8, 1),
))  # fmt: skip
VALUES: dict[str, Any] = {
    "Robot/speed": 0.1, "Robot/far": -2.5e300, "on": True, "bits": [True, False, True, True], "word": 65535,
    "big": 2**64 - 1, "grid": [[1, -2], [3, 4]], "name": "Zoë", "for": -1500, "day": "2024-02-29",
    "when": "2024-02-29T12:34:56.123456789", "where": "0102030405ff", "clock": 5,
}  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with a recording of three frames of many types.

    The first frame is good, the second has no image, the third has a NaN and an invalid time of day.
    """
    monkeypatch.chdir(tmp_path)
    data = bytearray(KINDS.size)
    for register in KINDS.registers:
        codec(register).encode_into(VALUES[register.path], data)
    with build(tmp_path / "kinds.mem") as work:
        work.block("cell", KINDS)
        work.frame(1, bytes(data))
        work.frame(2, bytes(KINDS.size), source_ns=0, quality=Quality.BAD, reason="no data yet")
        codec(KINDS.registers[0]).encode_into(math.nan, data)
        data[64:72] = b"\xff" * 8
        work.frame(3, bytes(data), quality=Quality.UNCERTAIN)
    return tmp_path


def test_parquet_has_the_types_of_the_registers(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "kinds.mem", "-o", "out"]) == 0
    assert capsys.readouterr().out == "out/cell.parquet: 3 rows\n"
    table = parquet.read_table("out/cell.parquet")
    types = {field.name: str(field.type) for field in table.schema}
    assert {path: types[path] for path in VALUES} == {
        "Robot/speed": "float", "Robot/far": "double", "on": "bool",
        "bits": "fixed_size_list<element: bool>[4]", "word": "uint16", "big": "uint64",
        "grid": "fixed_size_list<element: fixed_size_list<element: int16>[2]>[2]", "name": "string",
        "for": "duration[ms]", "day": "date32[day]", "when": "timestamp[ns]", "where": "fixed_size_binary[6]",
        "clock": "duration[ns]",
    }  # fmt: skip
    assert table["when"].cast("int64").to_pylist()[0] % 10**9 == 123456789
    first, nothing, last = table.drop(["time", "source_time", "when", "clock"]).to_pylist()
    assert table["time"].cast("int64").to_pylist() == [START_NS + n * PERIOD_NS for n in (1, 2, 3)]
    assert (first["quality"], nothing["quality"], last["quality"]) == ("good", "bad", "uncertain")
    for path in ("on", "bits", "word", "big", "grid", "name"):
        assert first[path] == VALUES[path], path
        assert last[path] == VALUES[path], path
    assert np.float32(first["Robot/speed"]) == np.float32(0.1)
    assert (first["where"].hex(), str(first["day"])) == ("0102030405ff", "2024-02-29")
    assert [table[name].is_null().to_pylist() for name in ("source_time", "when", "word")] == [[False, True, False]] * 3
    assert not any(nothing[path] for path in VALUES if path not in ("bits", "grid", "when", "clock"))
    assert math.isnan(last["Robot/speed"])
    assert table["clock"].cast("int64").to_pylist() == [5, None, None]


def test_csv(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "kinds.mem", "-o", "out", "--format", "csv"]) == 0
    with Path("out/cell.csv").open(newline="", encoding="utf-8") as file:
        first, nothing, last = csv.DictReader(file)
    assert first["time"] == "2023-11-14T22:13:20.020000000Z"
    expected = {
        "Robot/speed": "0.1", "Robot/far": "-2.5e+300", "on": "true", "bits/0": "true", "bits/1": "false",
        "word": "65535", "big": str(2**64 - 1), "grid/0/1": "1", "grid/0/2": "-2", "grid/1/2": "4", "name": "Zoë",
        "for": "-1500", "day": "2024-02-29", "when": "2024-02-29T12:34:56.123456789", "where": "0102030405ff",
        "clock": "5",
    }  # fmt: skip
    assert {path: first[path] for path in expected} == expected
    assert (nothing["quality"], nothing["word"], nothing["name"]) == ("bad", "", "")
    assert (last["Robot/speed"], last["clock"]) == ("nan", "")


def test_mcap_for_viewers(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "kinds.mem", "-o", "out.mcap", "--format", "mcap"]) == 0
    with Path("out.mcap").open("rb") as file:
        messages = list(make_reader(file, validate_crcs=True).iter_messages())
    assert [(channel.topic, channel.message_encoding) for _, channel, _ in messages] == [("/cell", "json")] * 3
    schema, _, message = messages[0]
    assert schema is not None
    assert schema.encoding == "jsonschema"
    properties = json.loads(schema.data)["properties"]
    assert properties["Robot"]["properties"]["speed"] == {"type": "number"}
    assert properties["grid"] == {"type": "array", "items": {"type": "array", "items": {"type": "integer"}}}
    assert message.log_time == START_NS + PERIOD_NS
    first, nothing, last = (json.loads(message.data) for _, _, message in messages)
    assert first.pop("frame") == {"number": 1, "cycle": 1, "quality": 2, "provenance": 0}
    robot = first.pop("Robot")
    assert (np.float32(robot["speed"]), robot["far"]) == (np.float32(0.1), -2.5e300)
    assert first == {path: value for path, value in VALUES.items() if "/" not in path}
    assert list(nothing) == ["frame"]
    assert (last["Robot"]["speed"], last["clock"]) == (None, None)


def test_registers_named_like_other_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each such register has a column, which replaces none of the frame's own columns."""
    names = ("time", "source_time", "number", "cycle", "quality", "provenance", "what", "frame/number")
    layout = Layout("DB2", 2, 16, False, tuple(Register(n, "INT", (), 2 * i, None, 2, 1) for i, n in enumerate(names)))
    with build(tmp_path / "names.mem") as work:
        work.block("cell", layout)
        work.frame(7, bytes(byte if byte % 2 else 0 for byte in range(16)))
    values = list(range(1, 16, 2))
    own = [f"cell/{name}" for name in names[:6]]
    for form in ("parquet", "csv"):
        assert main(["export", "names.mem", "-o", f"out.{form}"]) == 0
    table = parquet.read_table("out.parquet").to_pylist()[0]
    assert [table[name] for name in (*own, *names[6:])] == values
    assert (table["number"], table["cycle"], table["quality"], table["provenance"]) == (7, 7, "good", "live")
    with Path("out.csv").open(newline="", encoding="utf-8") as file:
        [row] = csv.DictReader(file)
    assert [row[name] for name in (*own, *names[6:])] == list(map(str, values))
    assert (row["number"], row["quality"]) == ("7", "good")
    assert main(["export", "names.mem", "-o", "out.mcap"]) == 0
    with Path("out.mcap").open("rb") as mcap:
        [(schema, _, message)] = make_reader(mcap).iter_messages()
    told = json.loads(message.data)
    assert (told["frame"]["number"], told["cell/frame"]["number"], told["time"]) == (7, values[7], values[0])
    assert schema is not None
    assert set(json.loads(schema.data)["properties"]) == set(told)
    capsys.readouterr()
    assert main(["cat", "names.mem", "--csv"]) == 0
    heading, *_ = csv.reader(capsys.readouterr().out.splitlines())
    assert heading[:6] == ["time", "source", "what", "number", "quality", "text"]
    assert len(set(heading)) == len(heading)


def test_options_for_time_source_registers_and_raw_values(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    varied(tmp_path / "a.mem")
    some = ["--from", "0.1", "--to", "0.3", "--only", "cell/count", "press/row"]
    assert main(["export", "a.mem", "-o", "out", *some]) == 0
    assert capsys.readouterr().out.splitlines() == ["out/cell.parquet: 11 rows", "out/press.parquet: 11 rows"]
    assert parquet.read_table("out/cell.parquet")["count"].to_pylist()[3] == 1009
    assert parquet.read_table("out/press.parquet").column_names[6:] == ["row"]
    assert main(["export", "a.mem", "-o", "raw", "--raw", *some]) == 0
    assert parquet.read_table("raw/cell.parquet")["count"].to_pylist() == list(range(6, 17))
    assert main(["export", "a.mem", "-o", "v.mcap", "--format", "mcap", "--source", "cell"]) == 0
    with Path("v.mcap").open("rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert (topics.count("/cell"), topics.count("/cell/events"), len(topics)) == (57, 4, 61)


def test_each_block_has_its_own_file(tmp_path: Path) -> None:
    other = Layout("DB1", 1, 2, False, (Register("count", "INT", (), 0, None, 2, 1),))
    with build(tmp_path / "a.mem") as work:
        work.block("cell")
        work.frame(1, image(1))
        work.block("cell", other, section=9)
        work.frame(2, b"\0\7")
    assert main(["export", "a.mem", "-o", "out"]) == 0
    assert parquet.read_table("out/cell.parquet")["count"].to_pylist() == [1]
    assert parquet.read_table("out/cell-2.parquet")["count"].to_pylist() == [7]


def test_refused_export_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["export", "kinds.mem", "-o", "out", "--from", "100"]) == 1
    assert "kinds.mem has no frames in that time" in capsys.readouterr().err
    assert main(["export", "kinds.mem", "-o", "out", "--source", "x"]) == 1
    assert capsys.readouterr().err == "unknown source 'x'; valid: cell\n"
    assert main(["export", "kinds.mem", "-o", "out"]) == 0
    before = Path("out/cell.parquet").read_bytes()
    assert main(["export", "kinds.mem", "-o", "out"]) == 1
    assert Path("out/cell.parquet").read_bytes() == before
    capsys.readouterr()
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert main(["export", "kinds.mem", "-o", "more"]) == 1
    assert capsys.readouterr().err == "pyarrow is not installed; run pip install 'shmio[analysis]'\n"
    assert not Path("more").exists()


@pytest.mark.parametrize("output", ["new/deep", "there", "new.csv", "new.mcap"])
def test_ctrl_c_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str) -> None:
    """Ctrl-C comes after some of the frames are written."""
    varied(tmp_path / "a.mem")
    Path("there").mkdir()
    before = sorted(tmp_path.rglob("*"))
    made: list[Path] = []

    def interrupt(*_: object) -> None:
        made.extend(path for path in tmp_path.rglob("*") if path.is_file() and path not in before)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Progress, "at", interrupt)
    assert main(["export", "a.mem", "-o", output, "--source", "cell"]) == 130
    assert len(made) == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_suffix_chooses_the_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An output with a known suffix is one file; any other output is a folder."""
    for name in ("x.mcap", "x.csv", "X.Parquet", "x.d"):
        assert main(["export", "kinds.mem", "-o", name]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "x.mcap: 3 messages",
        "x.csv: 3 rows",
        "X.Parquet: 3 rows",
        "x.d/cell.parquet: 3 rows",
    ]
    with Path("x.mcap").open("rb") as file:
        assert [channel.topic for _, channel, _ in make_reader(file).iter_messages()] == ["/cell"] * 3
    assert main(["export", "kinds.mem", "-o", "out", "--format", "csv"]) == 0
    assert Path("x.csv").read_bytes() == Path("out/cell.csv").read_bytes()
    assert Path("X.Parquet").read_bytes() == Path("x.d/cell.parquet").read_bytes()
    Path("there.csv").mkdir()
    assert main(["export", "kinds.mem", "-o", "there.csv", "--format", "csv"]) == 0
    assert Path("there.csv/cell.csv").is_file()


def test_unsuitable_output_name_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "kinds.mem", "-o", "x.csv", "--format", "parquet"]) == 1
    message = "x.csv: the ending of this name contradicts --format parquet; change one of the two\n"
    assert capsys.readouterr().err == message
    varied(tmp_path / "a.mem")
    assert main(["export", "a.mem", "-o", "x.csv"]) == 1
    assert capsys.readouterr().err == "x.csv can hold only one block, but there are 2 (cell, press); name a folder\n"
    assert not Path("x.csv").exists()
    assert main(["export", "a.mem", "-o", "x.csv", "--source", "press"]) == 0


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("x.xlsx", "-o x.csv writes a file that Excel and LibreOffice can open"),
        ("run.1.ODS", "-o run.1.csv writes a file that Excel and LibreOffice can open"),
        ("x.mem", "shmio-dump cut FILE… -o x.mem writes a part of a recording to a new one"),
        ("x.h5", "choose a name that ends in one of .parquet, .csv, .mcap, or a folder and --format"),
    ],
)
@pytest.mark.parametrize("asked", [(), ("--format", "csv")])
def test_unsupported_suffix_is_refused_with_a_remedy(
    name: str, remedy: str, asked: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", "kinds.mem", "-o", name, *asked]) == 1
    suffix = Path(name).suffix.lower()
    assert capsys.readouterr().err == f"{name}: export does not write {suffix}; {remedy}\n"
    assert not Path(name).exists()


def test_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    for name, what in (("out", "rows"), ("x.mcap", "messages")):
        form = ["--format", "csv"] if name == "out" else []
        assert main(["export", "--json", "kinds.mem", "-o", name, *form]) == 0
        file = "out/cell.csv" if name == "out" else name
        assert json.loads(capsys.readouterr().out) == {"files": [{"file": file, what: 3}], "damage": []}
    assert main(["export", "--json", "kinds.mem", "-o", "x.xlsx"]) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {"error": err.rstrip()}
    assert main(["export", "--json", "no.mem", "-o", "x.csv"]) == 1
    assert json.loads(capsys.readouterr().out) == {"error": "no.mem: No such file or directory"}


def test_single_file_needs_one_block_with_frames_in_the_time_range(capsys: pytest.CaptureFixture[str]) -> None:
    """A block that has only events in that range does not count."""
    with build(Path("a.mem")) as work:
        work.block("cell")
        work.block("press", section=2)
        for number in range(1, 31):
            work.frame(number, image(number))
            if number <= 10:
                work.frame(number, image(number), "press")
        work.event(1, 30, "late", "press")
    assert main(["export", "a.mem", "-o", "x.csv", "--from", str(19 * PERIOD_NS / 1e9)]) == 0
    assert capsys.readouterr().out == "x.csv: 11 rows\n"


def test_damaged_chunk_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Undamaged frames are exported, and the exit status is 1."""
    file = varied(tmp_path / "a.mem")
    data = bytearray(file.read_bytes())
    with shmio.open_dump(file) as dump:
        chunks = [chunk for chunk, _, _ in dump._parts[0].found.chunks.between(0, 2**62)]
    data[chunks[2].at + 70] ^= 1
    file.write_bytes(data)
    assert main(["export", "a.mem", "-o", "out", "--only", "press/count"]) == 1
    assert "a.mem: lost after " in capsys.readouterr().err
    assert 45 < len(parquet.read_table("out/press.parquet")) < 60
