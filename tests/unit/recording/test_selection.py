"""Recordings of chosen sources and registers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mcap.reader
import pytest

from shmio.cli.dump import main
from shmio.layout.model import Layout, Register
from shmio.recording.check import check
from shmio.recording.reading.reader import Reader
from shmio.recording.selection import Selection
from shmio.segment import BlockSpec, Frame, ProcessSpec, Segment
from tests.unit.recorder.harness import numbers, publish, read, recorder

LAYOUT = Layout(
    "DB1",
    1,
    8,
    False,
    (
        Register("speed", "REAL", (), 0, None, 4, 1),
        Register("doors/left", "BOOL", (), 4, 0, 1, 1),
        Register("doors/right", "BOOL", (), 4, 1, 1, 1),
        Register("list", "BYTE", ((1, 2),), 6, None, 2, 2),
    ),
)
IMAGE = bytes.fromhex("11223344ff550102")


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    """Create a segment with two sources of this layout."""
    blocks = [BlockSpec(name, LAYOUT, 20_000_000, 60_000_000_000, 1 << 20) for name in ("cell", "press")]
    processes = [ProcessSpec("cell", "source"), ProcessSpec("recorder", "recorder")]
    with Segment.create(instance, blocks, processes) as segment:
        yield segment
        segment.unlink()


def recorded(segment: Segment, folder: Path, *registers: str, sources: list[str] | None = None) -> Path:
    work = recorder(segment, folder, selection=Selection(sources, registers))
    for name in ("cell", "press"):
        writer = segment.writer(name)
        writer.publish(IMAGE, cycle=1, effective=bytes(7) + b"\7")
        writer.publish(IMAGE, cycle=2)
    assert work.close()
    return work.output.path


@pytest.mark.parametrize(
    ("registers", "kept", "paths"),
    [
        (["cell/speed"], "1122334400000000", ["speed"]),
        (["cell/doors"], "0000000003000000", ["doors/left", "doors/right"]),
        (["cell/doors/right"], "0000000002000000", ["doors/right"]),
        (["cell/**/left", "cell/list/2"], "0000000001000102", ["doors/left", "list"]),
        (["cell/sp*/out", "cell/l*", "nothing/such"], "1122334400000102", ["speed", "list"]),
        (["cell"], IMAGE.hex(), ["speed", "doors/left", "doors/right", "list"]),
    ],
)
def test_registers_that_are_not_chosen_are_zero_and_not_in_the_layout(
    segment: Segment, tmp_path: Path, registers: list[str], kept: str, paths: list[str]
) -> None:
    file = recorded(segment, tmp_path, *registers)
    frames = [message.item for message in read(file) if isinstance(message.item, Frame)]
    assert [frame.raw.hex() for frame in frames] == [kept] * 2
    assert frames[0].effective == (bytes(7) + b"\7" if "list" in paths else bytes(8))
    with Reader(file) as reader:
        assert check(reader).whole
        [channel] = [channel for channel in reader.channels.values() if channel.topic == "cell/frames"]
        layout = reader.layout(channel)
    assert [register.path for register in layout.registers] == paths
    assert (layout.size, layout.hash == LAYOUT.hash) == (8, len(paths) == 4)
    with file.open("rb") as stream:
        summary = mcap.reader.make_reader(stream).get_summary()
        assert summary is not None
        whole = [one.metadata.get("of") for one in summary.channels.values() if one.topic == "cell/frames"]
    assert whole == [None if len(paths) == 4 else LAYOUT.hash.hex()]


def test_sources_without_a_chosen_register_are_not_recorded(segment: Segment, tmp_path: Path) -> None:
    file = recorded(segment, tmp_path, "press/speed")
    assert (numbers(file), numbers(file, "press")) == ([], [1, 2])


def test_sources_and_registers_limit_together(segment: Segment, tmp_path: Path) -> None:
    file = recorded(segment, tmp_path, "press/speed", "cell/list", sources=["cell"])
    assert (numbers(file), numbers(file, "press")) == ([1, 2], [])


def test_shmio_dump_record_with_chosen_registers(
    segment: Segment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = ["record", "--instance", segment.instance, "-o", str(tmp_path), "--for", "0.01"]
    assert main([*record, "--register", "cell/speed", "cell/nothing"]) == 1
    assert "cell/nothing: no register has this path" in capsys.readouterr().err
    assert main([*record, "--register", "cell/sped"]) == 1
    assert capsys.readouterr().err == "cell/sped: no register has this path; did you mean 'cell/speed'?\n"
    assert list(tmp_path.iterdir()) == []
    publish(segment.writer("cell"), 1)
    assert main([*record, "--register", "cell/speed"]) == 0
    assert len(list(tmp_path.iterdir())) == 1
