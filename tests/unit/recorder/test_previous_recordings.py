"""How a recorder finds where the previous one ended, in files that are damaged or large."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode

from shmio.recorder import previous_recordings
from shmio.recorder.previous_recordings import last_positions
from shmio.recording.format.encoding import BlockPosition
from shmio.recording.format.records import MAGIC, Record
from shmio.recording.reading.reader import Reader
from shmio.segment import Segment
from tests.unit.recorder.harness import publish, recorder

MB = 1 << 20


@pytest.fixture
def file(segment: Segment, tmp_path: Path) -> Path:
    """Make a previous recorder's file: two chunks with 10 frames of each source, and one chunk of press."""
    work = recorder(segment, tmp_path)
    for turn, sources in enumerate((("cell", "press"), ("cell", "press"), ("press",))):
        for source in sources:
            publish(segment.writer(source), 10, first=10 * turn)
        work.run_once()
        work._writer.flush()
    assert work.close()
    return work.output.path


def look(segment: Segment, folder: Path) -> tuple[dict[str, BlockPosition], int]:
    """Return the known positions by source, and the number of heartbeats during the search."""
    beats: list[None] = []
    found = last_positions(folder, segment, "test", lambda: beats.append(None))
    return {name: found[block.section] for name, block in segment.blocks.items() if block.section in found}, len(beats)


def chunks(file: Path) -> list[Record]:
    with Reader(file) as reader:
        return [record for record in reader.records.walk() if record.opcode == Opcode.CHUNK]


def test_a_large_file_that_is_not_a_recording_is_not_searched_to_its_end(segment: Segment, tmp_path: Path) -> None:
    with (tmp_path / f"{segment.instance}-20990101T000000Z.mem").open("wb") as stream:
        stream.write(MAGIC)
        stream.truncate(256 * MB)
    found, beats = look(segment, tmp_path)
    assert found == {}
    assert 1 <= beats < 10


def test_of_many_files_the_last_by_name_are_searched(
    segment: Segment, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.rename(tmp_path / f"{segment.instance}-20000101T000000Z.mem")
    publish(segment.writer("cell"), 5, first=20)
    work = recorder(segment, tmp_path)
    assert work.close()
    monkeypatch.setattr(previous_recordings, "MAX_FILES", 1)
    found, _ = look(segment, tmp_path)
    assert found["cell"].frame == 25


def test_the_heartbeat_continues_during_a_search_past_damage(segment: Segment, file: Path) -> None:
    """After a power failure, the rest of the file may be zeros."""
    end = chunks(file)[0]
    with file.open("rb+") as stream:
        stream.truncate(end.at + end.size)
        stream.truncate(64 * MB)
    found, beats = look(segment, file.parent)
    assert found["cell"].frame == 10
    assert beats >= 64


@pytest.mark.parametrize("what", ["many small records", "chunks that unpack to much"])
def test_the_heartbeat_continues_whatever_the_file_contains(segment: Segment, file: Path, what: str) -> None:
    """A search takes long if there are many records, or much data when unpacked, although the file is small."""
    begin = chunks(file)[0].start
    content = file.read_bytes()
    strange = struct.pack("<BQ", 0x80, 0) * 20_000
    if what != "many small records":
        inner = zstandard.compress(struct.pack("<BQ", 0x80, 8 * MB) + bytes(8 * MB))
        size = 8 * MB + 9
        packed = struct.pack("<QQQII4sQ", 1, 1, size, 0, 4, b"zstd", len(inner)) + inner
        strange = (struct.pack("<BQ", Opcode.CHUNK, len(packed)) + packed) * 20
    file.write_bytes(content[:begin] + strange + content[begin:])
    found, beats = look(segment, file.parent)
    assert (found["cell"].frame, found["press"].frame) == (20, 30)
    assert beats >= 20


def test_a_damaged_beginning_does_not_hide_where_it_ended(segment: Segment, file: Path) -> None:
    """Both descriptions of one channel are damaged, too, so that the channel's frames cannot be read any more."""
    expected, _ = look(segment, file.parent)
    content = bytearray(file.read_bytes())
    with Reader(file) as reader:
        first = chunks(file)[0]
        summary = [record for record in reader.records.summary() if record.opcode == Opcode.CHANNEL]
    lost = next(record for record in summary if b"cell/frames" in content[record.at : record.at + record.size])
    content[first.at + first.size - 1] ^= 1
    file.write_bytes(content)
    assert look(segment, file.parent)[0] == expected
    content[lost.at + 7] = 0xFF  # the length of its topic
    file.write_bytes(content)
    found, _ = look(segment, file.parent)
    assert found["press"] == expected["press"]
    assert (found["cell"].frame, found["cell"].event) == (0, expected["cell"].event)


def test_a_damaged_end_affects_only_the_blocks_in_it(segment: Segment, file: Path) -> None:
    """Frames that cannot be read any more are recorded again, if the ring still has them."""
    expected, _ = look(segment, file.parent)
    last = chunks(file)[-1]
    content = bytearray(file.read_bytes())
    content[last.at + last.size - 1] ^= 1
    file.write_bytes(content)
    assert look(segment, file.parent)[0] == {"cell": expected["cell"], "press": BlockPosition(0, 0, 0)}
