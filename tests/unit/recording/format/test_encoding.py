"""Encoding and decoding the messages of a recording, and bytes that cannot be decoded."""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.recording.format.encoding import (
    Gap,
    Reason,
    decode_event,
    decode_frame,
    decode_gap,
    encode_event,
    encode_frame,
    encode_json,
    restore,
)
from shmio.segment import Event, Frame, Provenance, Quality

u64, i64, u32 = st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**32 - 1)
u8, u16 = st.integers(0, 255), st.integers(0, 65535)
quality = st.sampled_from(Quality)
images = st.integers(0, 50).flatmap(
    lambda size: st.tuples(st.binary(min_size=size, max_size=size), st.none() | st.binary(min_size=size, max_size=size))
)


def differences(data: bytes, sequence: int, log_ns: int, publish_ns: int) -> bytes:
    """Convert a frame from the first version of the encoding to the second: the opposite of :func:`restore`."""
    number, cycle, published, clock, source = struct.unpack_from("<QQQQQ", data)
    fields = number - sequence, cycle - number, published - clock, clock - log_ns, source - publish_ns
    return struct.pack("<QQQQQ", *(field % 2**64 for field in fields)) + data[40:]


@given(
    st.tuples(u64, u64, i64, i64, i64, u32, quality, st.sampled_from(Provenance), u64, u32, st.text(max_size=60)),
    images,
    st.tuples(u32, u64, u64),
)
def test_a_frame(fields: tuple[int, ...], images: tuple[bytes, bytes | None], header: tuple[int, int, int]) -> None:
    """Both versions of the encoding are tested, with arbitrary values in the message's header."""
    frame = Frame._make((*fields, *images))
    data = encode_frame(frame)
    assert decode_frame(data) == frame
    assert restore(differences(data, *header), *header) == data


@given(
    st.tuples(u64, u16, u64, u64, i64, i64, i64, u32, quality, u32, u64, u32, u32, u32, u8, u32, u64),
    st.binary(max_size=256),
    st.text(max_size=30),
    st.text("abc ü(:.)", max_size=40),
)
def test_an_event(fields: tuple[int, ...], data: bytes, text: str, by: str) -> None:
    kind = fields[1]
    with_data, without = (
        kind in (4, 10, 12, 14),
        kind in (5, 6, 7, 8, 9, 11, 13, 17),
    )  # docs/reference/segment-format.md
    about = b"" if without else data, text, fields[-1], by if with_data or without else ""
    event = Event._make((*fields[:-1], *about))
    assert decode_event(encode_event(event)) == event


def test_a_gap() -> None:
    gap = Gap("cell", 1, "frames", 5, 9, 5, Reason.OVERTAKEN, 10, 20)
    assert decode_gap(encode_json(gap)) == gap


@pytest.mark.parametrize(
    "change",
    [
        {"count": 4},
        {"first": 10, "count": 0},
        {"what": "trees"},
        {"first": 0, "count": 10},
        {"after_ns": -(1 << 63)},
        {"before_ns": -1},
    ],
)
def test_a_contradictory_gap_is_refused(change: dict[str, object]) -> None:
    fields = {"source": "c", "block": 1, "what": "frames", "first": 5, "last": 9, "count": 5, "reason": "overtaken"}
    with pytest.raises(ValueError, match=r"inconsistent|negative time"):
        decode_gap(encode_json(Gap(**fields | change)))  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [0xFFFF // 3, 0xFFFF // 3 + 1])
def test_a_text_is_refused_if_it_could_not_be_encoded_again(size: int) -> None:
    """Each invalid byte of a text becomes a character that has three bytes."""
    text = "x" * size
    frame = Frame(7, 3, 10, 20, 30, 1, Quality.GOOD, Provenance.LIVE, 0, 0, text, b"", None)
    event = Event(7, 1, 3, 10, 20, 30, 40, 1, Quality.GOOD, 0, 0, 0, 0, 0, 0, 0, b"", text, 0)
    both: Any = ((encode_frame, decode_frame, frame), (encode_event, decode_event, event))
    for encode, decode, item in both:
        data = encode(item).replace(b"x", b"\xff")
        if size > 0xFFFF // 3:
            with pytest.raises(ValueError, match="does not match its header"):
                decode(data)
        else:
            assert len(encode(decode(data))) == len(data) + 2 * size


@given(st.binary(max_size=200))
def test_any_bytes_are_decoded_or_refused(data: bytes) -> None:
    for decode in (decode_frame, decode_event, decode_gap):
        with suppress(ValueError):
            decode(data)
