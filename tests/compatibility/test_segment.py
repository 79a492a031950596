"""Readers of the shared memory that were written before read a live segment, or refuse another ABI."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import shmio
from shmio.errors import FormatError
from shmio.segment.header import ABI_VERSION
from shmio.testing.cell import Cell, until
from tests.compatibility import segment_abi2
from tests.compatibility.segment_abi2 import Reader

SHM = Path("/dev/shm")
COMPILER = shutil.which("cc") or shutil.which("gcc") or "cc"


@pytest.fixture
def program(baseline: Path, tmp_path: Path) -> tuple[Path, int]:
    """Compile the reader of a stored version; return it, and the ABI that it knows."""
    output = tmp_path / "reader"
    subprocess.run([COMPILER, "-std=c11", baseline / "reader.c", "-o", output], check=True)
    known = re.search(r"\bABI = (\d+)", (baseline / "reader.c").read_text())
    assert known
    return output, int(known[1])


def run(program: Path, *arguments: str) -> tuple[int, str, str]:
    done = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stdout, done.stderr


def test_a_stored_reader_in_c_reads_or_refuses(program: tuple[Path, int], live: Cell) -> None:
    reader, known = program
    for path, shown in (("notes/level", "1.75"), ("notes/count", "-12"), ("notes/big", "0.5"), ("notes/on", "true")):
        if known == ABI_VERSION:
            if path == "notes/level":
                live.output("shmio", "set", "notes/count", "-12")
                live.output("shmio", "set", "notes/big", "0.5")
                live.output("shmio", "set", "notes/on", "true")
            status, output, errors = run(reader, live.instance, path, "1")
            assert (status, errors) == (0, "")
            assert re.fullmatch(rf"\d+ cycle \d+ missed \d+ good {re.escape(shown)} \n", output)
        else:
            status, output, errors = run(reader, live.instance, path, "1")
            assert (status, output) == (1, "")
            assert f"has ABI {ABI_VERSION}, this program knows {known}" in errors


@pytest.fixture
def newer(live: Cell, instance: str) -> Iterator[str]:
    """Return the name of a copy of the live segment with the next ABI."""
    file = SHM / f"shmio-{instance}"
    content = bytearray((SHM / f"shmio-{live.instance}").read_bytes())
    struct.pack_into("<I", content, 8, ABI_VERSION + 1)
    file.write_bytes(content)
    yield instance
    file.unlink()


def test_every_reader_refuses_a_newer_abi(program: tuple[Path, int], newer: str) -> None:
    reader, known = program
    status, _, errors = run(reader, newer, "notes/level", "1")
    assert (status, f"has ABI {ABI_VERSION + 1}, this program knows {known}" in errors) == (1, True)
    with pytest.raises(segment_abi2.RefusedError, match=f"has ABI {ABI_VERSION + 1}, this program knows 2"):
        Reader(SHM / f"shmio-{newer}")
    with pytest.raises(FormatError, match=rf"ABI {ABI_VERSION + 1} .*written by shmio.*knows only ABI {ABI_VERSION}"):
        shmio.attach(newer)


@pytest.fixture(scope="module")
def reader(live: Cell) -> Iterator[Reader]:
    if ABI_VERSION != segment_abi2.ABI:
        pytest.skip(f"segments have ABI {ABI_VERSION}")
    found = Reader(SHM / f"shmio-{live.instance}")
    yield found
    found.close()


def test_header(reader: Reader, live: Cell) -> None:
    header, status = reader.header(), live.status()
    size = (SHM / f"shmio-{live.instance}").stat().st_size
    assert (header["size"], header["epoch"] > 0, header["section_count"]) == (size, True, 17)
    assert (header["mode"], header["instance"], header["version"]) == ("live", live.instance, shmio.__version__)
    assert (header["pid"], header["state"], header["note"]) == (status["supervisor"]["pid"], 1, "")
    assert Path(header["control"]).is_socket()
    assert header["config"] == str(live.folder / "supervisor.toml")
    assert (header["section_entry_size"], header["process_slot_size"]) == (128, 1088)
    assert header["started"] < header["supervisor_heartbeat"]
    assert header["supervised_since"] == 0


def test_sections(reader: Reader) -> None:
    layout = reader.layout("notes")
    assert (layout["name"], layout["size"], layout["byte_order"]) == ("notes", 52, "big")
    assert reader.source("notes") == {
        "connector": "memory",
        "writable": ["**"],
        "armed": False,
        "stepped": True,
        "replay": False,
        "outputs": [],
        "inouts": [],
    }
    [declared] = reader.listed(segment_abi2.DECLARED, "notes")
    assert (declared["name"], declared["target"], declared["value"]) == ("drift", "notes/level", 0.25)
    [injection] = reader.listed(segment_abi2.INJECTIONS, "notes")
    assert (injection["direction"], injection["name"], injection["writer"]) == ("out", "drift", 2**32 - 1)
    assert (injection["ranges"], injection["running"]["state"]) == ([[0, 4, 255]], "active")


def test_frames(reader: Reader, live: Cell) -> None:
    live.output("shmio", "set", "notes/big", "-2.5")
    ring, frame = reader.ring(segment_abi2.FRAMES, "notes"), reader.frame("notes")
    assert (ring["frame_size"], ring["period"], ring["stale"]) == (52, 50_000_000, 60_000_000_000)
    assert ring["incarnation"] == frame["incarnation"] == 1
    assert (frame["quality"], frame["provenance"], frame["reason"]) == (2, 1, "")
    started = reader.header()
    assert frame["publish"] - started["started"] == frame["clock"]
    assert 0 <= frame["clock"] // 50_000_000 - frame["cycle"] < 200, "a cycle may be late"
    assert abs(frame["source"] - started["started_utc"] - frame["clock"]) < 60e9
    assert reader.value("notes", "level") == 1.75
    assert reader.value("notes", "level", "raw") == 1.5
    assert (reader.value("notes", "big"), reader.value("notes", "word")) == (-2.5, 0xBEEF)
    assert reader.value("sim", "joints/Kuka.j1/R") == 0
    assert ring["doorbell"] > 0


def test_events_and_queues(reader: Reader, live: Cell) -> None:
    before = len(reader.events("notes"))
    live.output("shmio", "set", "notes/row", "[10, 20, 30]")
    live.output("shmio-dump", "note", "a note", "--source", "notes")
    accepted, written, noted = reader.events("notes")[before:]
    assert (accepted["kind"], written["kind"], noted["kind"], noted["text"]) == (4, 6, 17, "a note")
    assert (accepted["offset"], accepted["mask"], accepted["size"]) == (34, 0, 6)
    assert accepted["data"] == struct.pack(">3h", 10, 20, 30)
    assert accepted["command"] == written["command"] != 0
    assert accepted["command"] >> 40 > 1
    assert (accepted["items"], accepted["item"], accepted["injection"]) == (1, 0, 0)
    assert 0 < accepted["frame"] <= written["frame"]
    queues = reader.queues("notes")
    assert max(head for head, _ in queues) > 0
    assert all(head == tail for head, tail in queues)
    assert [event["kind"] for event in reader.events("notes")[:4]] == [1, 12, 3, 15]


def test_processes(reader: Reader, live: Cell) -> None:
    live.processes()
    found, known = reader.processes(), live.processes()
    for name, kind in (("sim", "source"), ("notes", "source"), ("grpc", "grpc")):
        one = found[name]
        assert (one["kind"], one["pid"], one["phase"], one["activity"]) == (kind, known[name]["pid"], 2, 2)
        assert (one["restarts"], one["why"], one["problem"]) == (0, "", "")
        assert reader.header()["started"] < one["since"] < one["started"] < one["heartbeat"]
    polls = found["notes"]["counters"]
    assert 0 < polls[0] <= known["notes"]["counters"]["polls"]
    assert 19_000 < polls[5] < 21_000 or polls[5] > 0
    assert found["grpc"]["writer"] > 0


def test_readers_and_clock(reader: Reader, live: Cell) -> None:
    slot = reader.processes()["grpc"]
    with shmio.connect(str(live.grpc)) as cell:
        next(iter(cell.subscribe("notes/count")))
        until(lambda: slot["index"] in reader.readers("notes"), "the endpoint reports its lag")
    pid, last = reader.readers("notes")[slot["index"]]
    assert (pid, 0 < last <= reader.ring(segment_abi2.FRAMES, "notes")["head"]) == (slot["pid"], True)
    clock = reader.clock()
    assert (clock["mode"], clock["flags"], clock["owner"], clock["stepped"]) == (0, 0, 0, 0)
    assert clock["slot_count"] == reader.header()["process_capacity"]
    with shmio.attach(live.instance, writable=True) as cell:
        stepped = cell.step(0.03)
        clock = reader.clock()
        assert (clock["mode"], clock["step"], clock["done"]) == (1, stepped.step, stepped.step)
        assert (clock["time"], clock["dt"], clock["step_size"]) == (stepped.time_ns, 30_000_000, 50_000_000)
        assert clock["owner"] > 0
        assert reader.frame("notes")["cycle"] == stepped.step
        cell.release()
    until(lambda: reader.clock()["mode"] == 0, "real time again")
    assert reader.clock()["time"] == stepped.time_ns
