"""The writer of MCAP files, compared with the mcap library's own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from shmio.recording.format import mcap_writer
from shmio.recording.format.encoding import encode_frame
from shmio.recording.format.mcap_writer import McapWriter, Message
from shmio.segment import Frame
from tests.unit.recording.format.test_encoding import differences
from tests.unit.recording.format.test_frames import ONE, frames

u64, u32, names = st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1), st.text(max_size=8)
message = st.tuples(u64, u64, u32, st.lists(st.binary(max_size=30), max_size=3))
calls = st.lists(
    st.one_of(
        st.tuples(st.just("schema"), names, st.binary(max_size=20)),
        st.tuples(st.just("channel"), names, names, st.dictionaries(names, names, max_size=2)),
        st.tuples(st.just("messages"), st.integers(0, 3), st.lists(message, max_size=8)),
        st.tuples(st.just("frames"), st.integers(0, 3), st.lists(st.tuples(u64, frames), max_size=4)),
        st.tuples(st.just("attachment"), u64, u64, names, st.binary(max_size=20)),
        st.tuples(st.just("metadata"), names, st.dictionaries(names, names, max_size=2)),
        st.tuples(st.just("flush")),
    ),
    max_size=15,
)
CHUNK_BYTES = 300


class LibraryWriter(Writer):
    """The library's writer, with the method that ours has for messages."""

    def add_messages(self, channel: int, messages: Iterable[Message]) -> None:
        for log_ns, publish_ns, sequence, data in messages:
            self.add_message(channel, log_ns, b"".join(data), publish_ns, sequence)

    def add_frames(self, channel: int, frames: Iterable[tuple[int, Frame]]) -> None:
        for log_ns, frame in frames:
            publish_ns, sequence = frame.source_ns if frame.source_ns > 0 else log_ns, frame.number % 2**32
            data = differences(encode_frame(frame), sequence, log_ns, publish_ns)
            self.add_message(channel, log_ns, data, publish_ns, sequence)


def ours(made: list[Any]) -> bytes:
    stream = BytesIO()
    play(McapWriter(stream, "profile", "library"), made)
    return stream.getvalue()


def theirs(made: list[Any]) -> bytes:
    stream = BytesIO()
    writer = LibraryWriter(stream, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
    writer.start("profile", "library")
    play(writer, made)
    return stream.getvalue()


def play(writer: McapWriter | LibraryWriter, made: list[Any]) -> None:
    channels = [writer.register_channel("first", "", writer.register_schema("s", "e", b""), {})]
    for what, *args in made:
        match what, args:
            case "schema", (name, data):
                writer.register_schema(name, "text/plain", data)
            case "channel", (topic, encoding, metadata):
                channels.append(writer.register_channel(topic, encoding, 1, metadata))
            case "messages", (channel, messages):
                writer.add_messages(channels[channel % len(channels)], messages)
            case "frames", (channel, some):
                writer.add_frames(channels[channel % len(channels)], some)
            case "attachment", (create_ns, log_ns, name, data):
                writer.add_attachment(create_ns, log_ns, name, "text/plain", data)
            case "metadata", (name, metadata):
                writer.add_metadata(name, metadata)
            case _:
                writer.flush()
    writer.finish()


@pytest.fixture(scope="module", autouse=True)
def small_chunks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_writer, "CHUNK_BYTES", CHUNK_BYTES)
        yield


FULL = ("messages", 0, [(1, 1, 1, [bytes(CHUNK_BYTES - 100)])])


@given(calls)
@example([FULL, ("schema", "s", bytes(100)), FULL])
@example([FULL, ("channel", "t", "e", {"k": "v" * 100}), FULL])
@example([FULL, ("flush",), FULL, ("flush",)])
@example([("schema", "s", bytes(2 * CHUNK_BYTES)), ("frames", 0, [(1, ONE), (2, ONE)])])
def test_the_same_bytes_as_those_of_the_library(made: list[Any]) -> None:
    assert ours(made) == theirs(made)


def test_the_library_reads_every_message() -> None:
    messages = [(number, 2 * number, number, (b"head", bytes(number))) for number in range(100)]
    stream = BytesIO(ours([("messages", 0, messages)]))
    read = [
        (one.log_time, one.publish_time, one.sequence, one.data)
        for _, _, one in make_reader(stream, validate_crcs=True).iter_messages()
    ]
    assert read == [(*times, b"".join(data)) for *times, data in messages]


def test_a_flush_passes_all_messages_on_to_the_file(tmp_path: Path) -> None:
    file = tmp_path / "a.mcap"
    with file.open("wb", buffering=1 << 20) as stream:
        writer = McapWriter(stream, "profile", "library")
        channel = writer.register_channel("first", "", writer.register_schema("s", "e", b""))
        writer.add_messages(channel, [(1, 2, 3, (b"head", b"rest"))])
        writer.flush()
        records = StreamReader(BytesIO(file.read_bytes())).records
        (message,) = [one for one in islice(records, 4) if isinstance(one, Record)]
    assert message.data == b"headrest"
