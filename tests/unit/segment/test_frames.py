"""Runs of frames in C (frames.h): the same bytes and the same frames as Python encodes and decodes one at a time."""

from __future__ import annotations

import struct
from typing import Final

from hypothesis import given
from hypothesis import strategies as st

from shmio.fabric.messages import decode_entry, encode_entries
from shmio.model.values import Provenance, Quality
from shmio.segment._atomics import RAW_OFFSET, Ring
from shmio.segment.block import Frame, decode_frame
from tests.unit.segment.test_ring import ring_memory

SIZE: Final = 20
NEVER: Final = -(1 << 63)
LARGEST: Final = (1 << 64) - 1

images = st.binary(min_size=SIZE, max_size=SIZE)
times = st.integers(-(1 << 63), (1 << 63) - 1)
frames = st.builds(
    lambda plain, **fields: Frame(**fields) if not plain else Frame(**fields | {"quality": Quality.GOOD, "reason": ""}),
    st.booleans() | st.just(True),
    number=st.just(0),
    cycle=st.integers(0, LARGEST),
    publish_ns=times,
    clock_ns=times,
    source_ns=times,
    incarnation=st.just(1),
    quality=st.sampled_from(list(Quality)),
    provenance=st.sampled_from(list(Provenance)),
    event=st.integers(0, 3),
    delay_us=st.integers(0, (1 << 32) - 1),
    reason=st.text(max_size=8),
    raw=images,
    effective=st.none() | images,
)


def ring(**wrong: int) -> Ring:
    memory = ring_memory(size=SIZE, **wrong)
    found = Ring(memory, 0, len(memory))
    found.begin()
    return found


def publish(to: Ring, frame: Frame) -> None:
    to.publish(
        frame.raw, frame.effective, frame.cycle, frame.publish_ns, frame.clock_ns, frame.source_ns, frame.quality,
        frame.provenance, frame.event, frame.delay_us, frame.reason.encode(),
    )  # fmt: skip


def read(of: Ring, number: int) -> Frame:
    fields = of.read(number)
    assert fields is not None
    return decode_frame(fields)


def plain(frame: Frame) -> bool:
    return frame.quality is Quality.GOOD and not frame.reason


@given(st.lists(frames, max_size=20), st.integers(0, 20), st.integers(0, 3), st.integers(0, 20))
def test_packed_frames_are_those_that_python_encodes(
    published: list[Frame], after: int, event: int, limit: int
) -> None:
    near = ring()
    for frame in published:
        publish(near, frame)
    expected = []
    for number in range(after + 1, min(near.head(), after + limit) + 1):
        if near.read(number) is None or not plain(frame := read(near, number)) or frame.event > event:
            break
        expected.append(frame)
    entries, last, clock_ns = near.pack(after, event, limit)
    assert entries == encode_entries(expected)
    latest_ns = max((frame.clock_ns for frame in expected), default=0)
    assert (last, clock_ns) == (expected[-1].number if expected else after, latest_ns)


@given(st.lists(frames, max_size=8), st.integers(0, 12), times, st.integers(0, LARGEST), st.booleans())
def test_published_frames_are_those_that_python_decodes(
    owned: list[Frame], before: int, made_ns: int, late_ns: int, narrow: bool
) -> None:
    owned = [
        frame._replace(number=place + 1 + place // 5) for place, frame in enumerate(owned)
    ]  # a gap after the fifth
    data = b"head" + encode_entries(owned)
    far = ring(effective_offset=0, slot_stride=RAW_OFFSET + 24) if narrow else ring()
    expected: list[Frame] = []
    at = 4
    while at < len(data):
        frame, end = decode_entry(data, at)
        assert isinstance(frame, Frame)
        if not plain(frame) or frame.number != before + len(expected) + 1 or (narrow and frame.effective is not None):
            break
        expected.append(frame)
        last, at = at, end
    seen = far.doorbell()
    done = far.publish_packed(data, 4, before, 1000, 2000, 9, made_ns, late_ns)
    assert done == ((len(expected), last, at) if expected else (0, 4, 4))
    assert far.doorbell() == seen + bool(expected)
    assert far.head() == len(expected)
    for number, frame in enumerate(expected, 1):
        age_ns = late_ns + max(0, made_ns - frame.publish_ns)
        found = read(far, number)
        assert found == frame._replace(
            number=number, publish_ns=1000, clock_ns=2000, event=9, incarnation=1, delay_us=found.delay_us
        )
        exact_us = frame.delay_us + age_ns / 1000
        assert min(exact_us, (1 << 32) - 1) <= found.delay_us + 1 <= max(1, exact_us * (1 + 1e-9) + 3)


@given(st.lists(frames, max_size=4), st.data())
def test_of_damaged_entries_those_before_the_damage_are_published(owned: list[Frame], data: st.DataObject) -> None:
    message = encode_entries(frame._replace(number=number) for number, frame in enumerate(owned, 1))
    for _ in range(data.draw(st.integers(1, 4)) if message else 0):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(message[: data.draw(st.integers(0, len(message)))])
    far = ring()
    count, _, end = far.publish_packed(cut, 0, 0, 1000, 2000, 9, NEVER, 0)
    assert far.head() == count
    at = 0
    for number in range(1, count + 1):
        frame, at = decode_entry(cut, at)
        assert isinstance(frame, Frame)
        assert (frame.number, frame.raw, frame.effective) == (number, *read(far, number)[-2:])
    assert at == end


def test_a_damaged_head_packs_no_frames_that_do_not_exist() -> None:
    memory = ring_memory(size=SIZE)
    near = Ring(memory, 0, len(memory))
    near.begin()
    for cycle in range(3):
        near.publish(bytes(SIZE), None, cycle, 0, 0, 0, Quality.GOOD, Provenance.LIVE, 0, 0, b"")
    struct.pack_into("<Q", memory, 64, LARGEST)
    assert near.head() == LARGEST
    for after in (LARGEST // 2 - 1, LARGEST // 2, LARGEST // 2 + 1, LARGEST - 1):  # their sequences wrap
        assert near.pack(after, LARGEST, 4) == (bytearray(), after, 0)
