"""Recordings as they may be found: cut off anywhere, damaged, hostile, or something else."""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Channel
from mcap.writer import CompressionType, Writer

from shmio.errors import RecordingError
from shmio.recording.format.encoding import EVENT, FRAME, FRAME_V2
from shmio.recording.format.records import MAGIC, MAX_CHUNK_BYTES
from shmio.recording.reading.reader import Message, Reader
from shmio.recording.reading.survey import survey

CHUNK = 6  # opcode

any_input = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])


def look(file: Path) -> tuple[list[Message], bool]:
    """Return the messages that ``info`` and ``cat`` read, and whether the file was closed."""
    with Reader(file) as reader:
        found = survey(reader)
        for track in found.tracks.values():
            if track.channel.source:
                track.numbers(reader)
        return list(reader.messages()), reader.records.closed


def cut(file: Path) -> list[Message]:
    """Return the messages up to the damage in the file."""
    found = []
    with suppress(RecordingError), Reader(file) as reader:
        for message in reader.messages():
            found.append(message)  # noqa: PERF402  keeps the messages before the error
    return found


@pytest.mark.parametrize("whole", [True, False])
def test_a_survey_counts_the_messages(recording: bytes, tmp_path: Path, whole: bool) -> None:
    file = tmp_path / "x.mem"
    file.write_bytes(recording if whole else recording[: recording.rindex(b"cell/frames") - 400])
    with Reader(file) as reader:
        found = survey(reader)
        messages = list(reader.messages())
        counts = {track.channel.topic: track.count for track in found.tracks.values()}
        times = {track.channel.topic: (track.first_ns, track.last_ns) for track in found.tracks.values()}
    assert reader.records.closed == whole
    topics = [message.channel.topic for message in messages]
    assert counts == {topic: topics.count(topic) for topic in set(topics)}
    for topic, (first_ns, last_ns) in times.items():
        of_topic = [message.log_ns for message in messages if message.channel.topic == topic]
        assert (first_ns, last_ns) == (of_topic[0], of_topic[-1])


def test_a_file_cut_off_anywhere_is_read_up_to_the_cut(recording: bytes, tmp_path: Path) -> None:
    """A killed recorder leaves such a file. Every message of a complete chunk is read."""
    file = tmp_path / "x.mem"
    file.write_bytes(recording)
    whole, closed = look(file)
    assert closed
    longest = 0
    for size in range(len(MAGIC), len(recording), 211):
        file.write_bytes(recording[:size])
        try:
            messages, closed = look(file)
        except RecordingError:  # not even the metadata are complete
            assert longest == 0
            continue
        assert not closed
        assert messages == whole[: len(messages)]
        assert len(messages) >= longest
        longest = len(messages)
    assert longest == len(whole)


@any_input
@given(data=st.data())
def test_changed_bytes_are_refused_or_harmless(recording: bytes, tmp_path: Path, data: st.DataObject) -> None:
    changed = bytearray(recording)
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    file = tmp_path / "x.mem"
    file.write_bytes(changed)
    with suppress(RecordingError):
        look(file)
    cut(file)


@any_input
@given(st.binary(max_size=300))
def test_any_bytes_are_refused_or_read(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "x.mem"
    file.write_bytes(MAGIC + data)
    with suppress(RecordingError):
        look(file)


def test_zeros_at_the_end_are_reported(recording: bytes, tmp_path: Path) -> None:
    """A power failure may leave such a file."""
    file = tmp_path / "x.mem"
    cut_at = recording.rindex(b"cell/frames") - 400
    file.write_bytes(recording[:cut_at])
    before, _ = look(file)
    with Reader(file) as reader:
        ends = [record.at + record.size for record in reader.records.walk()]
    file.write_bytes(recording[: ends[-1]] + bytes(5000))
    with Reader(file) as reader:
        after = list(reader.messages())
        assert (reader.records.closed, reader.records.damage) == (False, f"there is no valid record at byte {ends[-1]}")
    assert after == before


def chunk(size: int, packed: bytes, compression: bytes = b"zstd", crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 1, size, crc) + struct.pack("<I", len(compression)) + compression
    content = head + struct.pack("<Q", len(packed)) + packed
    return MAGIC + struct.pack("<BQ", CHUNK, len(content)) + content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (chunk(1 << 40, zstandard.compress(b"x")), "but at most"),
        (chunk(5, zstandard.compress(bytes(MAX_CHUNK_BYTES * 2))), "sizes are inconsistent"),
        (chunk(5, zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1 << 20))), "chunk at byte 17"),
        (chunk(5, b"nonsense"), "chunk at byte 17 is damaged"),
        (chunk(5, b"12345", b""), "ends within a record"),
        (chunk(5, b"1234", b""), "sizes are inconsistent"),
        (chunk(4, b"1234", b"", crc=77), "checksum is wrong"),
        (chunk(4, b"1234", b"lz5"), "compression 'lz5' is unknown"),
        (chunk(9, struct.pack("<BQ", 5, 1 << 60), b""), "ends within a record"),
        (
            chunk(31, struct.pack("<BQ", 5, 22) + bytes(22), b""),
            "the file has messages of channel 0, which has no description",
        ),
    ],
)
def test_hostile_chunks_cost_no_memory_and_no_traceback(content: bytes, message: str, tmp_path: Path) -> None:
    file = tmp_path / "x.mem"
    file.write_bytes(content)
    with Reader(file) as reader, pytest.raises(RecordingError, match=message) as problem:
        list(reader.messages())
    assert str(file) in str(problem.value)
    assert "\n" not in str(problem.value)


def described(encoding: str) -> bytes:
    """Return a chunk that describes channel 1."""
    about = dict.fromkeys(("block", "section", "after", "period_ns", "stale_ns"), "1")
    builder = RecordBuilder()
    Channel(1, "cell/frames", encoding, {**about, "source": "cell", "layout": "00"}, 1).write(builder)
    data = builder.end()
    return chunk(len(data), data, b"")


@pytest.mark.parametrize("encodings", [(FRAME, FRAME_V2), (FRAME_V2, FRAME), (FRAME, EVENT)])
def test_a_channel_with_two_descriptions_is_refused(encodings: tuple[str, str], tmp_path: Path) -> None:
    """Otherwise a message could be read in two ways, depending on where the reader starts."""
    file = tmp_path / "x.mem"
    first, second = map(described, encodings)
    file.write_bytes(first + described(encodings[0])[len(MAGIC) :] + second[len(MAGIC) :])
    with Reader(file) as reader, pytest.raises(RecordingError, match="channel 1 has two different descriptions"):
        list(reader.messages())


def test_a_chunk_above_the_size_limit_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / "x.mem"
    size = MAX_CHUNK_BYTES + 1
    with file.open("wb") as stream:
        stream.write(MAGIC + struct.pack("<BQ", CHUNK, size) + struct.pack("<QQQIIQ", 0, 1, size, 0, 0, size - 40))
        stream.truncate(MAX_CHUNK_BYTES + 100)
    with Reader(file) as reader, pytest.raises(RecordingError, match="is larger than"):
        list(reader.messages())


def foreign(file: Path, change: Callable[[Writer], Any]) -> None:
    with file.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("ros2")
        change(writer)
        writer.finish()


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "is empty: its recorder wrote nothing"), (b"PK\3\4", "it does not begin like an MCAP file")],
)
def test_files_that_are_not_recordings_are_refused(content: bytes, message: str, tmp_path: Path) -> None:
    file = tmp_path / "x.mem"
    file.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        Reader(file)


def test_an_mcap_file_of_another_program_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "x.mcap"

    def change(writer: Writer) -> None:
        channel = writer.register_channel("/tf", "cdr", 0)
        writer.add_message(channel, 1, b"abc", 1)

    foreign(file, change)
    with Reader(file) as reader, pytest.raises(RecordingError, match="is an MCAP file, but not a recording of shmio"):
        survey(reader)


def test_a_changed_layout_is_refused(recording: bytes, tmp_path: Path) -> None:
    file = tmp_path / "x.mem"
    changed = recording.replace(b'"path":"count"', b'"path":"tnuoc"')
    assert changed != recording
    file.write_bytes(changed)
    with Reader(file) as reader, pytest.raises(RecordingError, match="the layout of cell/frames is damaged"):
        list(reader.messages())
