"""The check of recordings with changed bytes: it reports the damage, and reads the rest."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.recording import block_follower
from shmio.recording.check import Findings, check
from shmio.recording.format.records import MAGIC, Damage, Record
from shmio.recording.reading.reader import Message, Reader
from shmio.segment import Frame, Segment
from tests.unit.recorder.harness import publish, recorder

any_change = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def found_in(file: Path) -> Findings:
    with Reader(file) as reader:
        return check(reader)


def read_on(file: Path) -> tuple[list[Message], list[Damage]]:
    """Return all messages that can be read, and the damage."""
    damage: list[Damage] = []
    with Reader(file) as reader:
        return list(reader.messages(damaged=damage.append)), damage


def records(file: Path, opcode: Opcode) -> list[Record]:
    with Reader(file) as reader:
        return [record for record in reader.records.walk() if record.opcode == opcode]


def by_chunk(file: Path) -> list[list[Message]]:
    with Reader(file) as reader:
        walk = [record for record in reader.records.walk() if record.opcode == Opcode.CHUNK]
    messages, _ = read_on(file)
    with Reader(file) as reader:
        counts = [len(list(reader.raw(record))) for record in walk]
    return [messages[sum(counts[:turn]) : sum(counts[: turn + 1])] for turn in range(len(walk))]


@pytest.fixture
def file(recording: bytes, tmp_path: Path) -> Path:
    """Make an undamaged recording of several chunks with a gap."""
    path = tmp_path / "x.mem"
    path.write_bytes(recording)
    return path


def test_an_unchanged_file_is_whole(file: Path, recording: bytes) -> None:
    found = found_in(file)
    assert found.whole, (found.damage, found.problems)
    assert found.chunks == len(records(file, Opcode.CHUNK)) > 4
    assert found.messages == len(read_on(file)[0])
    file.write_bytes(recording[: records(file, Opcode.CHUNK)[-1].start])
    assert found_in(file).whole, "a file without its end is not damaged"


@any_change
@given(data=st.data())
def test_no_changed_byte_goes_unnoticed(file: Path, recording: bytes, data: st.DataObject) -> None:
    changed = bytearray(recording)
    changed[data.draw(st.integers(0, len(changed) - 1))] ^= data.draw(st.integers(1, 255))
    file.write_bytes(changed)
    try:
        with Reader(file) as reader:
            assert not check(reader).whole or not reader.records.closed
    except RecordingError:  # it is not a recording any more
        pass


@any_change
@given(data=st.data())
def test_no_removed_piece_goes_unnoticed(file: Path, recording: bytes, data: st.DataObject) -> None:
    begin = data.draw(st.integers(0, len(recording) - 1))
    end = data.draw(st.integers(begin + 1, len(recording)))
    file.write_bytes(recording[:begin] + recording[end:])
    try:
        with Reader(file) as reader:
            assert not check(reader).whole or not reader.records.closed
    except RecordingError:
        pass


def test_the_place_of_each_damaged_chunk_is_reported_and_the_rest_is_read(file: Path, recording: bytes) -> None:
    chunks, walk = by_chunk(file), records(file, Opcode.CHUNK)
    for turn, record in enumerate(walk):
        changed = bytearray(recording)
        changed[record.at + record.size - 1] ^= 1
        file.write_bytes(changed)
        messages, [damage] = read_on(file)
        assert messages == [message for number, some in enumerate(chunks) if number != turn for message in some]
        assert (damage.first, damage.last) == (record.at, record.at + record.size - 1)
        assert f"the chunk at byte {record.at} is damaged" in damage.why
        assert damage.after_ns == (max(m.log_ns for m in chunks[turn - 1]) if turn else 0)
        assert damage.before_ns == (min(m.log_ns for m in chunks[turn + 1]) if turn + 1 < len(chunks) else 0)
        found = found_in(file)
        assert found.damage == [damage]
        numbers = [message.item.number for message in chunks[turn] if isinstance(message.item, Frame)]
        if numbers and turn + 1 < len(chunks):
            gap = 11 if turn == 2 else numbers[0]
            lost = f"cell, block 1: frames {gap} to {numbers[-1]} are missing, but no gap is recorded for them"
            assert lost in found.problems


@pytest.mark.parametrize("opcode", [Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.METADATA])
@pytest.mark.parametrize("size", [0, 1, 5000, 1 << 40])
def test_a_wrong_length_affects_only_its_own_chunk(file: Path, recording: bytes, opcode: Opcode, size: int) -> None:
    whole = by_chunk(file)
    chunks = records(file, Opcode.CHUNK)
    for record in records(file, opcode)[:3]:
        changed = bytearray(recording)
        changed[record.at - 8 : record.at] = struct.pack("<Q", size)
        file.write_bytes(changed)
        messages, [damage] = read_on(file)
        assert messages == [
            message for some, chunk in zip(whole, chunks, strict=True) if chunk != record for message in some
        ]
        assert damage.first == record.start
        with Reader(file) as reader:
            assert not check(reader).whole
            assert reader.records.closed


@pytest.mark.parametrize("field", [0, 8])
def test_times_of_a_chunk_that_differ_from_its_messages_are_reported(file: Path, recording: bytes, field: int) -> None:
    """No CRC covers the times in the chunk's header."""
    chunk = records(file, Opcode.CHUNK)[1]
    changed = bytearray(recording)
    changed[chunk.at + field] ^= 1
    file.write_bytes(changed)
    found = found_in(file)
    assert found.problems == [f"the chunk at byte {chunk.at}: its times differ from those of its messages"]
    assert found.damage == []


def test_a_block_without_its_layout_is_still_checked_for_missing_numbers(file: Path, recording: bytes) -> None:
    record = records(file, Opcode.ATTACHMENT)[-1]
    changed = bytearray(recording)
    changed[record.at + record.size - 9] ^= 1
    file.write_bytes(changed)
    found = found_in(file)
    assert f"the attachment at byte {record.at} is damaged" in found.damage[0].why
    assert found.problems == [], "no number is missing"


def test_a_hole_across_two_chunks_is_reported_once(file: Path, recording: bytes) -> None:
    """A bad sector leaves such a file."""
    first, second = records(file, Opcode.CHUNK)[2:4]
    whole = by_chunk(file)
    changed = bytearray(recording)
    changed[first.at + 50 : second.at + 60] = bytes(second.at + 60 - first.at - 50)
    file.write_bytes(changed)
    messages, [damage] = read_on(file)
    assert messages == [m for number, some in enumerate(whole) if number not in (2, 3) for m in some]
    assert damage.first <= first.at + 50
    assert damage.last >= second.at + 59


def test_only_damage_within_the_requested_time_is_reported(file: Path, recording: bytes) -> None:
    chunks, record = by_chunk(file), records(file, Opcode.CHUNK)[2]
    changed = bytearray(recording)
    changed[record.at - 5] ^= 1  # changes its length, which every reader notices
    file.write_bytes(changed)
    damage: list[Damage] = []
    times = {"early": (0, chunks[0][-1].log_ns), "late": (chunks[-1][0].log_ns, 1 << 63), "there": (0, 1 << 63)}
    told = {}
    for name, (from_ns, to_ns) in times.items():
        with Reader(file) as reader:
            list(reader.messages(from_ns=from_ns, to_ns=to_ns, damaged=damage.append))
        told[name], damage = len(damage), []
    assert told == {"early": 0, "late": 0, "there": 1}


def test_without_a_summary_a_damaged_first_chunk_loses_its_channels(file: Path, recording: bytes) -> None:
    """The summary of a closed file repeats the descriptions of its channels."""
    chunks, expected = records(file, Opcode.CHUNK), [message for some in by_chunk(file)[1:] for message in some]
    changed = bytearray(recording)
    changed[chunks[0].at + chunks[0].size - 1] ^= 1
    file.write_bytes(changed)
    closed, _ = read_on(file)
    assert closed == expected
    file.write_bytes(changed[: chunks[-1].at + chunks[-1].size])
    messages, damage = read_on(file)
    topics = {message.channel.topic for message in messages}
    assert topics < {message.channel.topic for message in closed}
    assert damage


def test_the_search_among_false_chunks_is_bounded(file: Path, recording: bytes) -> None:
    record = records(file, Opcode.CHUNK)[0]
    bad = bytearray(recording[record.start : record.at + record.size])
    bad[-1] ^= 1
    meta = records(file, Opcode.METADATA)[0]
    begin = recording[: meta.at + meta.size]
    file.write_bytes(begin + b"\xff" * 20 + bytes(bad) * 99 + recording[record.start :])
    messages, _ = read_on(file)
    assert messages
    file.write_bytes(begin + b"\xff" * 20 + bytes(bad) * 101 + recording[record.start :])
    with Reader(file) as reader:
        assert list(reader.messages(damaged=lambda _: None)) == []
        assert "ends within a record" in reader.records.damage or reader.records.closed


def test_missing_numbers_outside_of_gaps_are_reported(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recorder of this test loses frames without recording a gap."""
    work = recorder(segment, tmp_path)
    writer = segment.writer("cell")
    publish(writer, 5)
    work.run_once()
    with monkeypatch.context() as broken:
        read = block_follower.BlockFollower._consecutive
        broken.setattr(block_follower.BlockFollower, "_consecutive", lambda self, frames: read(self, frames)[:0])
        publish(writer, 3)
        work.run_once()
    publish(writer, 2)
    assert work.close()
    assert found_in(work.output.path).problems == [
        "cell, block 1: frames 6 to 8 are missing, but no gap is recorded for them"
    ]


def test_files_that_are_not_shmio_recordings_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.mem").write_bytes(MAGIC + struct.pack("<BQ", Opcode.HEADER, 8) + bytes(8))
    with pytest.raises(RecordingError, match="not a recording of shmio"):
        found_in(tmp_path / "x.mem")
