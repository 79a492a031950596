"""Recorded events in the output of ``shmio-dump``: registers, values, direction and sender."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader

from shmio.cli.dump import main
from shmio.layout.model import Layout, Register
from shmio.segment import EventKind, Record, Write
from tests.unit.recording.build import build, image

GRPC, PROGRAM = 4, 0
BITS = [((6, 8), "cell/on"), ((1, 1), "cell/count.%X0"), ((0, 128), "cell/count.%X15"), ((11, 2), "cell/row/2.%X1")]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def accepted(write: Write, item: int = 0, writer: int = GRPC, kind: EventKind = EventKind.ACCEPTED) -> Record:
    return Record(kind, "", writer, 99, item, 1, write.offset, write.mask, len(write.data), write.data)


def recorded(*records: Record) -> str:
    with build(Path("a.mem")) as work:
        work.block("cell")
        work.frame(1, image(1))
        for record in records:
            work.tell(record)
    return "a.mem"


def told(capsys: pytest.CaptureFixture[str], *records: Record) -> list[dict[str, Any]]:
    """Record the events and return them as ``cat --json`` prints them."""
    assert main(["cat", "--json", recorded(*records)]) == 0
    return [found for line in capsys.readouterr().out.splitlines() if "event" in (found := json.loads(line))]


def test_command_has_registers_values_direction_and_sender(capsys: pytest.CaptureFixture[str]) -> None:
    first, second = Write(0, 0, b"\0\5"), Write(8, 0, b"\0\6\0\7")
    ended = Record(EventKind.WRITTEN, "", GRPC, 99, 0, 2, 0, 0, 2)
    found = told(capsys, accepted(first), accepted(second, 1), ended)
    assert [event["values"] for event in found] == [{"cell/count": 5}, {"cell/row/1..2": [6, 7]}, {}]
    assert found[2]["paths"] == ["cell/count", "cell/row/1..2"], "the paths of all items"
    assert {(event["by"], event["direction"]) for event in found} == {("grpc", "in")}
    main(["cat", "a.mem"])
    lines = [line.partition(": ")[2] for line in capsys.readouterr().out.splitlines() if "event" in line]
    assert lines == [
        "accepted cell/count/in = 5 by grpc, command 99.0",
        "accepted cell/row/1..2/in = [6,7] by grpc, command 99.1",
        "written cell/count/in, cell/row/1..2/in by grpc, command 99.0",
    ]


@pytest.mark.parametrize(("place", "path"), BITS)
def test_bits_have_paths(place: tuple[int, int], path: str, capsys: pytest.CaptureFixture[str]) -> None:
    offset, mask = place
    [event] = told(capsys, accepted(Write(offset, mask, bytes([mask]))))
    assert event["values"] == {path: True}


def test_bytes_without_a_path_are_printed_as_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    part = accepted(Write(2, 0, b"\1\2"), writer=PROGRAM, kind=EventKind.SHADOWED)
    padding, beyond = accepted(Write(7, 0, b"\1")), accepted(Write(15, 0, b"\1\2\3"))
    found = told(capsys, part, padding, beyond, accepted(Write(0, 0, b"\1"), kind=EventKind.DIVERTED))
    assert [(event["paths"], event["values"]) for event in found] == [
        (["cell/speed"], {}),
        ([], {}),
        ([], {}),
        (["cell/count.%B1"], {"cell/count.%B1": 1}),
    ]
    assert [(event["offset"], event["data"]) for event in found[1:3]] == [(7, "01"), (15, "010203")]
    assert (found[0]["by"], found[0]["direction"]) == ("program 1", "out")
    main(["cat", "a.mem"])
    assert "accepted 1 bytes at 7 by grpc" in capsys.readouterr().out


def test_injection_is_printed_with_its_definition(capsys: pytest.CaptureFixture[str]) -> None:
    how = {"direction": "out", "priority": 3, "keep": False, "ranges": [[0, 2, 255], [6, 1, 8]]}
    drift = {"name": "drift", "target": "cell/speed/in", "operation": "offset", "value": 2.5, "note": "x" * 300}
    document = msgspec.json.encode(drift)
    laid = Record(EventKind.INJECTED, "test", PROGRAM, 7, 0, 1, 0, 0, 0, msgspec.json.encode(how), 7)
    parts = [
        Record(EventKind.INJECTED, "drift", GRPC, 8, 0, 1, at, 0, len(part), part, 8)
        for at in range(0, len(document), 256)
        if (part := document[at : at + 256])
    ]
    lifted = Record(EventKind.LIFTED, "lifted", GRPC, 9, 0, 1, injection=7)
    old = Record(EventKind.INJECTED, "of a version before", PROGRAM, 6, 0, 1, injection=6)
    found = told(capsys, laid, *parts, Record(EventKind.ACTIVATED, "drift", injection=8), lifted, old)
    assert (found[0]["paths"], found[0]["direction"]) == (["cell/count", "cell/on"], "out")
    assert found[0]["laid"] == {name: how[name] for name in ("direction", "priority", "keep")}
    assert [event["laid"] for event in found[1:3]] == [None, drift], "the last part has the definition"
    assert found[3]["direction"] == "in"
    assert (found[4]["paths"], found[4]["direction"]) == (["cell/count", "cell/on"], "out")
    assert (found[5]["paths"], found[5]["laid"]) == ([], None)
    main(["cat", "a.mem"])
    out = capsys.readouterr().out
    assert ': drift target = "cell/speed/in", operation = "offset", value = 2.5, note = ' in out
    assert "injected cell/count/out, cell/on/out by program 1, command 7.0: test priority = 3" in out
    assert document[:8].hex() not in out


def test_mcap_export_has_all_fields_of_an_event(capsys: pytest.CaptureFixture[str]) -> None:
    told(capsys, accepted(Write(0, 0, b"\0\5")), accepted(Write(7, 0, b"\1"), 1))
    assert main(["export", "a.mem", "-o", "a.mcap"]) == 0
    with Path("a.mcap").open("rb") as stream:
        messages = [json.loads(m.data) for _, _, m in make_reader(stream).iter_messages(topics=["/cell/events"])]
    first, second = messages
    assert (first["values"], first["paths"], first["by"], first["direction"]) == (
        {"cell/count": 5}, ["cell/count"], "grpc", "in",
    )  # fmt: skip
    assert (second["offset"], second["size"], second["data"], second["item"]) == (7, 1, "01", 1)


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_table_of_events(form: str, capsys: pytest.CaptureFixture[str]) -> None:
    from pyarrow import parquet

    two = accepted(Write(8, 0, b"\0\6\0\7\0\x08\0"), 1)
    recorded(
        accepted(Write(0, 0, b"\0\5")), two._replace(offset=0, data=b"\0\1" + bytes(5), size=7), Record(EventKind.NOTED)
    )
    assert main(["export", "a.mem", "--events", "-o", f"events.{form}"]) == 0
    assert capsys.readouterr().out == f"events.{form}: 3 rows\n"
    if form == "csv":
        with Path("events.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
    else:
        rows = parquet.read_table("events.parquet").to_pylist()
    about = [tuple(str(row[name]) for name in ("kind", "path", "value", "direction", "by", "command")) for row in rows]
    assert about == [
        ("accepted", "cell/count", "5", "in", "grpc", "99"),
        (
            "accepted",
            "cell/count, cell/speed, cell/on",
            '{"cell/count": 1, "cell/speed": 0.0, "cell/on": false}',
            "in",
            "grpc",
            "99",
        ),
        ("noted", "", "", "", "", "0"),
    ]
    assert main(["export", "a.mem", "--events", "-o", "folder"]) == 1
    assert "--events writes one table" in capsys.readouterr().err


def test_events_have_the_paths_of_their_own_block(capsys: pytest.CaptureFixture[str]) -> None:
    """Events before a reload keep their paths, although the source's new block has other registers."""
    with build(Path("a.mem")) as work:
        work.block("cell")
        work.tell(accepted(Write(0, 0, b"\0\5")))
        work.block("cell", Layout("DB2", 2, 2, False, (Register("high", "INT", (), 0, None, 2, 1),)), section=2)
        work.tell(accepted(Write(0, 0, b"\0\5")), after=2)
    assert main(["cat", "--json", "a.mem"]) == 0
    found = [json.loads(line)["paths"] for line in capsys.readouterr().out.splitlines() if '"event"' in line]
    assert found == [["cell/count"], ["cell/high"]]
