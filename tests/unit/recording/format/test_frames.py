"""The encoder of frames in C, compared with the description of the format in Python's own terms."""

from __future__ import annotations

import struct
from io import BytesIO
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.recording.format import _frames, mcap_writer
from shmio.recording.format.encoding import encode_frame, restore
from shmio.recording.format.mcap_writer import McapWriter
from shmio.segment import Frame, Provenance, Quality
from tests.unit.recording.format.test_encoding import i64, images, quality, u32, u64

HEADER = struct.Struct("<BQHIQQ")
MESSAGE = 5

frames = st.builds(
    lambda fields, both: Frame._make((*fields, *both)),
    st.tuples(u64, u64, i64, i64, i64, u32, quality, st.sampled_from(Provenance), u64, u32, st.text(max_size=60)),
    images,
)
ONE = Frame(7, 3, 10, 20, 30, 1, Quality.GOOD, Provenance.LIVE, 0, 0, "", b"raw", None)


@given(frames, u64, st.integers(0, 2**16 - 1))
def test_a_frame_becomes_a_message(frame: Frame, log_ns: int, channel: int) -> None:
    parts: list[bytes] = []
    index: list[int] = []
    done = _frames.add(parts, index, channel, [(log_ns, frame)], 0, 50, 50)
    record = b"".join(parts)
    assert (done, index) == ((1, 50 + len(record)), [log_ns, 50])
    header, data = HEADER.unpack_from(record), record[HEADER.size :]
    published_ns = frame.source_ns if frame.source_ns > 0 else log_ns
    sequence = frame.number % 2**32
    assert header == (MESSAGE, len(record) - 9, channel, sequence, log_ns, published_ns)
    assert restore(data, sequence, log_ns, published_ns) == encode_frame(frame)


@given(st.lists(st.tuples(u64, frames), max_size=6), st.integers(0, 400))
def test_a_chunk_ends_after_the_frame_that_makes_it_too_large(some: list[tuple[int, Frame]], limit: int) -> None:
    whole: list[bytes] = []
    starts: list[int] = []
    _, end = _frames.add(whole, starts, 1, some, 0, 0, 2**60)
    at, done, chunks = 0, 0, [b""]
    while done < len(some):
        parts: list[bytes] = []
        index: list[int] = []
        done, size = _frames.add(parts, index, 1, some, done, 0, limit)
        chunks.append(b"".join(parts))
        assert size == len(chunks[-1]) > 0
        assert done == len(some) or size > limit
        assert index[1::2] == [start - at for start in starts[1::2] if at <= start < at + size]
        at += size
    assert (b"".join(chunks), at) == (b"".join(whole), end)


def test_the_writer_makes_the_same_file_of_frames_in_any_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", 300)
    some = [(number, ONE._replace(number=number, raw=bytes(number))) for number in range(1, 60)]
    files = []
    for cuts in ([0, 59], range(60), [0, 1, 30, 59]):
        writer = McapWriter(stream := BytesIO(), "profile", "library")
        channel = writer.register_channel("first", "", writer.register_schema("s", "e", b""), {})
        for first, last in pairwise(cuts):
            writer.add_frames(channel, some[first:last])
        writer.finish()
        files.append(stream.getvalue())
    assert files[0] == files[1] == files[2]


@pytest.mark.parametrize(
    ("entries", "first", "error"),
    [
        ([ONE], 0, TypeError),
        ([(1, tuple(ONE)[:-1])], 0, TypeError),
        ([(1, ONE._replace(cycle="x"))], 0, TypeError),  # type: ignore[arg-type]
        ([(1, ONE._replace(reason=b""))], 0, TypeError),  # type: ignore[arg-type]
        ([(1, ONE._replace(raw=None))], 0, TypeError),  # type: ignore[arg-type]
        ([(1, ONE._replace(reason="\udc80"))], 0, UnicodeEncodeError),
        ([(1, ONE._replace(reason=2**16 * "x"))], 0, OverflowError),
        ([(-1, ONE)], 0, OverflowError),
        ([(1, ONE)], -1, ValueError),
    ],
)
def test_what_is_no_frame_is_refused(entries: list[Any], first: int, error: type[Exception]) -> None:
    parts, index = [b"before"], [0, 0]
    with pytest.raises(error):
        _frames.add(parts, index, 1, [*[(1, ONE)] * (first + 1), *entries], first, 0, 1000)
    assert (parts, index) == ([b"before"], [0, 0]), "the chunk is as before"
