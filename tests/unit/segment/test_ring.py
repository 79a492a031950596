"""The ring and the cells, used by the extension's Python functions."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.segment import _atomics
from shmio.segment._atomics import RAW_OFFSET, RING_HEADER_SIZE, Ring

HEADER = struct.Struct("<8Iqq")


def ring_memory(slots: int = 8, size: int = 20, **wrong: int) -> bytearray:
    image = -(-size // 8) * 8
    stride = RAW_OFFSET + 2 * image
    fields = {
        "slot_count": slots,
        "slot_stride": stride,
        "frame_size": size,
        "reserved3": 0,
        "raw_offset": RAW_OFFSET,
        "effective_offset": RAW_OFFSET + image,
        "reserved4": 0,
        "reserved": 0,
        "period_ns": 20_000_000,
        "stale_ns": 500_000_000,
    } | wrong
    memory = bytearray(RING_HEADER_SIZE + slots * stride)
    HEADER.pack_into(memory, 0, *fields.values())
    return memory


def publish(ring: Ring, raw: bytes, cycle: int = 1, effective: bytes | None = None, reason: bytes = b"") -> int:
    return ring.publish(raw, effective, cycle, 10, 20, 30, 2, 0, 0, 0, reason)


def test_an_empty_ring_has_no_frame() -> None:
    memory = ring_memory()
    ring = Ring(memory, 0, len(memory))
    assert (ring.head(), ring.latest(), ring.read(1)) == (0, None, None)
    assert (ring.slot_count, ring.frame_size, ring.period_ns, ring.stale_ns) == (8, 20, 20_000_000, 500_000_000)


def test_a_frame_survives_a_round_trip() -> None:
    memory = ring_memory()
    ring = Ring(memory, 0, len(memory))
    assert ring.begin() == 1
    raw = bytes(range(20))
    assert ring.publish(raw, None, 7, 100, 200, -300, 1, 3, 11, 17, "grün".encode()) == 1
    assert ring.latest() == (1, 7, 100, 200, -300, 1, 1, 3, 11, 17, "grün", raw, None)
    assert ring.read(1) == ring.latest()


def test_the_effective_image_exists_only_if_given() -> None:
    memory = ring_memory()
    ring = Ring(memory, 0, len(memory))
    ring.begin()
    publish(ring, bytes(20), effective=b"\x01" * 20)
    publish(ring, bytes(20))
    first, second = ring.read(1), ring.read(2)
    assert first is not None
    assert second is not None
    assert (first[-1], second[-1]) == (b"\x01" * 20, None)


def test_an_overwritten_frame_is_gone() -> None:
    memory = ring_memory(slots=4)
    ring = Ring(memory, 0, len(memory))
    ring.begin()
    for cycle in range(10):
        publish(ring, struct.pack("<5I", *[cycle] * 5), cycle)
    assert ring.read(6) is None
    oldest = ring.read(7)
    assert oldest is not None
    assert oldest[1] == 6
    assert ring.read(11) is None


class Copy(tuple[object, ...]):
    __slots__ = ()


def test_many_frames_are_read_at_once_up_to_one_that_is_missing() -> None:
    memory = ring_memory()
    ring = Ring(memory, 0, len(memory))
    ring.begin()
    for cycle in range(1, 12):
        publish(ring, bytes([cycle] * 20), cycle, bytes([100 + cycle] * 20) if cycle % 2 else None, b"why")
    qualities, provenances = tuple(f"q{number}" for number in range(256)), tuple(range(1000, 1256))
    many = ring.read_many(6, 3, Copy, qualities, provenances)
    assert [type(frame) for frame in many] == [Copy] * 3
    for frame, single in zip(many, (ring.read(6), ring.read(7), ring.read(8)), strict=True):
        assert single is not None
        assert frame == (*single[:6], "q2", 1000, *single[8:])
        assert hash(frame) == hash(tuple(frame))
    assert [frame[0] for frame in ring.read_many(4, 99, Copy, qualities, provenances)] == list(range(4, 12))
    for first, count in ((3, 9), (12, 9), (0, 9), (5, 0), (5, -1), (2**64 - 1, 2)):
        assert ring.read_many(first, count, Copy, qualities, provenances) == []
    for wrong in ((object, qualities, provenances), (Copy, (), provenances), (Copy, qualities, provenances[1:])):
        with pytest.raises(TypeError, match="256"):
            cast("Any", ring).read_many(5, 1, *wrong)


def test_a_half_written_slot_is_never_read_and_is_reused() -> None:
    memory = ring_memory()
    ring = Ring(memory, 0, len(memory))
    ring.begin()
    publish(ring, b"a" * 20)
    slot = RING_HEADER_SIZE + 2 * (RAW_OFFSET + 48)
    struct.pack_into("<Q", memory, slot, 2 * 2 + 1)  # the odd sequence of frame 2
    memory[slot + RAW_OFFSET : slot + RAW_OFFSET + 10] = b"torn torn "
    assert ring.read(2) is None
    latest = ring.latest()
    assert latest is not None
    assert latest[-2] == b"a" * 20
    assert ring.begin() == 2
    assert publish(ring, b"b" * 20) == 2
    written = ring.read(2)
    assert written is not None
    assert (written[5], written[-2]) == (2, b"b" * 20)


def test_publishing_needs_a_writer_a_writable_buffer_and_the_right_size() -> None:
    memory = ring_memory()
    ring = Ring(memory, 0, len(memory))
    with pytest.raises(ValueError, match=r"begin\(\)"):
        publish(ring, bytes(20))
    ring.begin()
    with pytest.raises(ValueError, match="20 bytes"):
        publish(ring, bytes(19))
    with pytest.raises(ValueError, match="20 bytes"):
        publish(ring, bytes(20), effective=bytes(21))
    with pytest.raises(TypeError, match="read-only"):
        Ring(bytes(memory), 0, len(memory)).begin()
    assert ring.head() == 0


def test_publishing_refuses_wrong_arguments() -> None:
    ring = Ring(ring_memory(), 0, len(ring_memory()))
    ring.begin()
    right = [bytes(20), bytes(20), 1, 10, 20, 30, 2, 0, 0, 0, b""]
    for place, value in (
        (0, "text"), (1, 1), (2, 1.5), (3, 2**63), (5, None), (6, 256), (6, -1), (7, 2**70), (8, "1"), (9, None),
        (10, ""),
    ):  # fmt: skip
        wrong = [*right[:place], value, *right[place + 1 :]]
        with pytest.raises((TypeError, OverflowError)):
            cast("Any", ring).publish(*wrong)
    with pytest.raises(TypeError):
        cast("Any", ring).publish(*right[:10])
    assert ring.head() == 0


def test_a_long_reason_is_cut() -> None:
    memory = ring_memory()
    ring = Ring(memory, 0, len(memory))
    ring.begin()
    publish(ring, bytes(20), reason=b"x" * 1000)
    latest = ring.latest()
    assert latest is not None
    assert latest[10] == "x" * _atomics.REASON_SIZE


@pytest.mark.parametrize(
    "wrong",
    [
        {"slot_count": 0},
        {"slot_count": 7},
        {"slot_count": 1 << 25},
        {"frame_size": 0},
        {"frame_size": 1 << 30},
        {"raw_offset": 8},
        {"effective_offset": RAW_OFFSET},
        {"effective_offset": (1 << 32) - 8},
        {"slot_stride": 8},
        {"slot_stride": (1 << 32) - 8},
    ],
)
def test_a_contradictory_header_is_refused(wrong: dict[str, int]) -> None:
    memory = ring_memory(**wrong)
    with pytest.raises(ValueError, match=r"."):
        Ring(memory, 0, len(memory))


@given(st.binary(max_size=600), st.integers(-10, 700), st.integers(-10, 700))
def test_any_bytes_are_refused_or_readable(data: bytes, offset: int, size: int) -> None:
    try:
        ring = Ring(data, offset, size)
    except ValueError:
        return
    ring.latest()
    ring.read(1)


@given(st.binary(min_size=RING_HEADER_SIZE + 8 * (RAW_OFFSET + 48), max_size=RING_HEADER_SIZE + 8 * (RAW_OFFSET + 48)))
def test_any_slots_with_a_valid_header_are_readable(data: bytes) -> None:
    memory = ring_memory()
    memory[64:] = data[64:]
    ring = Ring(memory, 0, len(memory))
    for number in range(10):
        ring.read(number)


@pytest.mark.parametrize("private", [False, True])
def test_a_waiter_is_woken_by_the_next_frame(private: bool) -> None:
    memory = ring_memory()
    ring, reader = (Ring(memory, 0, len(memory), private=private) for _ in range(2))
    ring.begin()
    seen = ring.doorbell()
    assert reader.wait(seen, 0) == seen  # no ring: it returns after the time-out
    waiter = threading.Thread(target=reader.wait, args=(seen, -1))
    waiter.start()
    publish(ring, bytes(20))
    waiter.join(10)
    assert not waiter.is_alive()
    assert ring.wait(seen, -1) != seen  # a ring before the call: it returns at once


def in_thread(work: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_readers_see_whole_frames_in_order_while_the_ring_wraps() -> None:
    memory = ring_memory(slots=8, size=800)
    ring = Ring(memory, 0, len(memory))
    ring.begin()
    publish(ring, bytes(800))
    problems: list[str] = []
    done = threading.Event()

    def read() -> None:
        last = 0
        while not done.is_set():
            fields = ring.latest()
            assert fields is not None
            words = set(struct.unpack("<100Q", fields[-2]))
            if len(words) != 1 or fields[0] < last:
                problems.append(f"frame {fields[0]} after {last} holds {words}")
            last = fields[0]

    readers = [in_thread(read) for _ in range(3)]
    for value in range(20_000):
        publish(ring, struct.pack("<Q", value) * 100)
    done.set()
    for reader in readers:
        reader.join()
    assert not problems


@given(st.binary(min_size=1, max_size=200), st.binary(min_size=1, max_size=200))
def test_a_cell_returns_the_last_written_value(first: bytes, second: bytes) -> None:
    memory = bytearray(256)
    _atomics.cell_write(memory, 8, first)
    assert _atomics.cell_read(memory, 8, len(first)) == first
    memory[8] |= 1  # a writer died half-way
    assert _atomics.cell_read(memory, 8, len(first)) is None
    _atomics.cell_write(memory, 8, second)
    assert _atomics.cell_read(memory, 8, len(second)) == second


def test_several_cells_are_written_at_once() -> None:
    memory = bytearray(64)
    _atomics.cells_write(memory, (0, 32), b"0123456789")
    assert [_atomics.cell_read(memory, at, 10) for at in (0, 32)] == [b"0123456789"] * 2
    for offsets, data in (((0, 48), bytes(10)), ((-8,), b""), ((4,), b""), ((0,), bytes(64)), ((2**62,), b"")):
        with pytest.raises(ValueError, match=r"buffer|aligned"):
            _atomics.cells_write(memory, offsets, data)
    with pytest.raises(BufferError):
        _atomics.cells_write(bytes(64), (0,), b"")


@pytest.mark.parametrize(("offset", "size"), [(-8, 8), (0, 10_000), (4, 8), (250, 8), (1 << 62, 8), (0, -1)])
def test_cells_and_words_stay_inside_the_buffer(offset: int, size: int) -> None:
    memory = bytearray(256)
    with pytest.raises(ValueError, match=r"outside|aligned"):
        _atomics.cell_read(memory, offset, size)
    if size == 8:
        with pytest.raises(ValueError, match=r"outside|aligned"):
            _atomics.load64(memory, offset)
        with pytest.raises(ValueError, match=r"outside|aligned"):
            _atomics.store64(memory, offset, 1)


ENTRY = struct.Struct("=IIII")


@given(st.binary(min_size=300, max_size=300), st.lists(st.tuples(st.integers(0, 299), st.integers(0, 255))), st.data())
def test_changed_names_exactly_the_entries_whose_bytes_differ(
    old: bytes, edits: list[tuple[int, int]], data: st.DataObject
) -> None:
    new = bytearray(old)
    for at, value in edits:
        new[at] = value
    places = st.integers(0, 299).flatmap(
        lambda offset: st.one_of(
            st.tuples(st.just(offset), st.integers(1, 300 - offset), st.just(0)),
            st.tuples(st.just(offset), st.just(1), st.sampled_from([1 << bit for bit in range(8)])),
        )
    )
    entries = data.draw(st.lists(places, max_size=30))
    expected = [
        i
        for i, (offset, size, mask) in enumerate(entries)
        if (
            (old[offset] ^ new[offset]) & mask
            if mask
            else old[offset : offset + size] != bytes(new[offset : offset + size])
        )
    ]
    table = b"".join(ENTRY.pack(*entry, index) for index, entry in enumerate(entries))
    assert _atomics.changed(old, bytes(new), table) == expected


def test_changed_refuses_entries_outside_the_image() -> None:
    with pytest.raises(ValueError, match="outside"):
        _atomics.changed(b"ab", b"ac", ENTRY.pack(1, 2, 0, 0))
    with pytest.raises(ValueError, match="outside"):
        _atomics.changed(b"ab", b"ac", ENTRY.pack(0xFFFFFFFF, 0xFFFFFFFF, 0, 0))
    with pytest.raises(ValueError, match="one size"):
        _atomics.changed(b"ab", b"abc", b"")
