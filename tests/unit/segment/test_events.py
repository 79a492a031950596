"""Events and frames of a block have one common order."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.layout.model import Layout, Register
from shmio.segment import BlockSpec, BlockWriter, EventKind, ProcessSpec, Quality, Record, Segment
from shmio.segment.events import ENDS, EVENT_DATA_SIZE, EVENT_SIZE, EVENT_SLOTS, decode_event

LAYOUT = Layout("DB1", 1, 2, False, (Register("count", "INT", (), 0, None, 2, 1),))


@pytest.fixture
def writer(instance: str) -> Iterator[BlockWriter]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 10**9, 1 << 22)
    with Segment.create(instance, [block], [ProcessSpec("cell", "source")]) as segment:
        yield segment.writer("cell")
        segment.unlink()


def test_a_writer_begins_with_a_started_event(writer: BlockWriter) -> None:
    first = writer.block.events.read(1)
    assert first is not None
    assert (first.kind, first.text, first.incarnation, first.frame) == (EventKind.STARTED, f"pid {os.getpid()}", 1, 0)


def test_an_event_survives_a_round_trip(writer: BlockWriter) -> None:
    writer.publish(b"\0\1", cycle=6)
    writer.cycle = 7
    data = bytes(range(200))
    number = writer.event(Record(EventKind.ACCEPTED, "grün", 4, 99, 3, 1, 12, 0, 200, data, 77, "web: Jürgen"))
    event = writer.block.events.read(number)
    assert event is not None
    assert (event.number, event.frame, event.cycle, event.quality) == (2, 1, 7, Quality.GOOD)
    assert event[9:] == (4, 99, 3, 1, 12, 0, 200, data, "grün", 77, "web: Jürgen")
    frame = writer.block.latest()
    assert frame is not None
    assert event.publish_ns - event.clock_ns == frame.publish_ns - frame.clock_ns


def test_an_event_says_who_sent_the_command(writer: BlockWriter) -> None:
    by = "web: anonymous (127.0.0.1)"
    full = b"\1" * EVENT_DATA_SIZE
    for kind in EventKind:
        data = full if kind in (EventKind.ACCEPTED, EventKind.DIVERTED, EventKind.INJECTED, EventKind.SHADOWED) else b""
        if not data and kind not in ENDS:
            continue
        event = writer.block.events.read(writer.event(Record(kind, "text", 0, 99, data=data, by=by)))
        assert event is not None
        assert (event.kind, event.text, event.data, event.by) == (kind, "text", data, by)
    long = "x" * 256
    for kind, shown in ((EventKind.NOTED, by), (EventKind.REJECTED, by), (EventKind.SHADOWED, "")):
        event = writer.block.events.read(writer.event(Record(kind, long, 0, 99, by=by)))
        assert event is not None
        assert (event.text[:255], event.by) == (long[:255], shown), "the text comes first"
    for by in ("", "local: uid 1"):
        event = writer.block.events.read(writer.event(Record(EventKind.SHADOWED, "name\x1fgrpc: token admin", by=by)))
        assert event is not None
        assert (event.text, event.by) == ("name\x1fgrpc: token admin", by), "the name of an injection is no sender"


def test_frames_and_events_refer_to_each_other(writer: BlockWriter) -> None:
    """Two threads write. A reader finds one order when it merges frames and events by their numbers."""

    def events() -> None:
        for item in range(300):
            writer.event(Record(EventKind.WRITTEN, command=1, item=item))

    with ThreadPoolExecutor() as pool:
        done = pool.submit(events)
        for cycle in range(300):
            writer.publish(b"\0\0", cycle=cycle)
        done.result()
    block = writer.block
    frames = [block.read(n) for n in range(max(1, block.ring.head() - 250), block.ring.head() + 1)]
    for frame in frames:
        assert frame is not None
        if frame.event:
            before = block.events.read(frame.event)
            assert before is not None
            assert before.frame < frame.number
        after = block.events.read(frame.event + 1)
        assert after is None or after.frame >= frame.number


def test_an_event_wakes_readers_that_wait_for_frames(writer: BlockWriter) -> None:
    ring = writer.block.ring
    seen = ring.doorbell()
    writer.event(Record(EventKind.QUALITY, "cable out"), quality=Quality.BAD)
    assert ring.doorbell() != seen


def test_a_slow_reader_counts_missed_events_exactly(writer: BlockWriter) -> None:
    cursor = writer.block.events.cursor()
    for item in range(EVENT_SLOTS + 500):
        writer.event(Record(EventKind.WRITTEN, item=item))
    items = [event.item for event in iter(cursor.poll, None)]
    assert len(items) + cursor.missed == EVENT_SLOTS + 500
    assert items == list(range(cursor.missed, EVENT_SLOTS + 500))


def test_the_largest_data_of_one_event(writer: BlockWriter) -> None:
    number = writer.event(Record(EventKind.ACCEPTED, data=b"\xff" * EVENT_DATA_SIZE, size=EVENT_DATA_SIZE))
    event = writer.block.events.read(number)
    assert event is not None
    assert event.data == b"\xff" * EVENT_DATA_SIZE


@given(st.binary(min_size=EVENT_SIZE, max_size=EVENT_SIZE), st.integers(0, 255))
def test_any_bytes_decode_to_a_valid_event(raw: bytes, quality: int) -> None:
    """The bytes come from another process. Invalid bytes must not cause a read out of bounds."""
    event = decode_event((5, 1, 2, 3, 4, 1, quality, 0, 9, 0, "", raw, None))
    assert len(event.data) <= EVENT_DATA_SIZE
    assert event.quality in Quality


def test_kinds_have_the_documented_numbers() -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "dump-format.md").read_text()
    found = re.search(r"\| kind \| (1 started.*) \|", page)
    assert found is not None
    assert found[1] == ", ".join(f"{kind.value} {kind}" for kind in EventKind)
