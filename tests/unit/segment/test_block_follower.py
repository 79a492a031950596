"""Following a block: frames in order, missed frames, and changes of quality."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from shmio.layout.model import Layout, Register
from shmio.segment import (
    BlockSpec,
    BlockWriter,
    FrameFollower,
    ProcessSpec,
    Quality,
    QualityChange,
    Segment,
    Stamp,
)
from shmio.segment.block import Cursor

LAYOUT = Layout("DB1", 1, 4, False, (Register("speed", "REAL", (), 0, None, 4, 1),))
PERIOD_NS = 20_000_000
STALE_NS = 3600 * 10**9
"""Age in ns after which frames are stale, longer than any test takes."""


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    spec = BlockSpec("cell", LAYOUT, PERIOD_NS, STALE_NS, 1 << 20)
    with Segment.create(instance, [spec], [ProcessSpec("cell", "source")]) as created:
        yield created
        created.unlink()


@pytest.fixture
def writer(segment: Segment) -> BlockWriter:
    return segment.writer("cell")


def publish(
    writer: BlockWriter, quality: Quality = Quality.GOOD, reason: str = "", *, old: bool = False, count: int = 1
) -> None:
    """Publish frames. With ``old``, the frames are already stale."""
    now_ns = time.monotonic_ns()
    at = Stamp(now_ns - 2 * STALE_NS, now_ns) if old else None
    for _ in range(count):
        writer.publish(bytes(4), cycle=1, quality=quality, reason=reason, at=at)


def take(follower: FrameFollower, *, aged: bool = True) -> QualityChange:
    frame = follower.poll()
    assert frame is not None
    return follower.take(frame, aged=aged)


def test_it_begins_with_the_newest_frame_and_reports_each_change_of_quality(
    segment: Segment, writer: BlockWriter
) -> None:
    publish(writer, Quality.BAD, "cut", count=3)
    follower = FrameFollower(segment.blocks["cell"])
    assert (follower.frame, follower.quality, follower.reason) == (None, Quality.BAD, "no data yet")
    publish(writer)
    publish(writer)
    publish(writer, Quality.UNCERTAIN, "late")
    publish(writer, Quality.BAD, "cut")
    publish(writer, Quality.BAD, "no answer")
    publish(writer)
    changes = [take(follower) for _ in range(7)]
    assert changes == [
        QualityChange.DETAIL,
        QualityChange.RECOVERED,
        QualityChange.NONE,
        QualityChange.DETAIL,
        QualityChange.BAD,
        QualityChange.DETAIL,
        QualityChange.RECOVERED,
    ]
    assert (follower.poll(), follower.missed, follower.stale) == (None, 0, False)
    follower.restart()
    assert take(follower) is QualityChange.RECOVERED


def test_a_frame_that_becomes_stale_is_reported_once(segment: Segment, writer: BlockWriter) -> None:
    follower = FrameFollower(segment.blocks["cell"])
    assert not follower.became_stale()
    publish(writer, old=True)
    assert take(follower, aged=False) is QualityChange.RECOVERED  # the reader is behind
    seen = [(follower.stale, follower.became_stale(), follower.stale) for _ in range(2)]
    assert seen == [(False, True, True), (True, False, True)]
    assert follower.reason.startswith("stale: ")
    publish(writer)
    assert take(follower) is QualityChange.RECOVERED
    assert not follower.became_stale()
    publish(writer, Quality.BAD, "cut")
    assert take(follower) is QualityChange.BAD
    assert not follower.stale  # bad for another reason
    assert not follower.became_stale()


@pytest.mark.parametrize("noticed", [True, False])
def test_a_gap_between_two_frames_is_reported_on_request(segment: Segment, writer: BlockWriter, noticed: bool) -> None:
    follower = FrameFollower(segment.blocks["cell"], notice_gaps=noticed)
    publish(writer, old=True)
    take(follower, aged=False)
    publish(writer)
    assert take(follower) is (QualityChange.GAP if noticed else QualityChange.NONE)
    publish(writer)
    assert take(follower) is QualityChange.NONE
    publish(writer, old=True)
    take(follower, aged=False)
    publish(writer, count=2)
    follower.resume(after=follower.last + 1)  # as if the skipped frame had come in time
    assert take(follower) is QualityChange.NONE


def test_too_far_behind_it_skips_to_the_newest_frame_and_counts_the_others(
    segment: Segment, writer: BlockWriter
) -> None:
    block = segment.blocks["cell"]
    follower, patient = FrameFollower(block, catch_up_s=10 * PERIOD_NS / 1e9), FrameFollower(block)
    publish(writer, count=10)
    assert [frame.number for frame in follower.read(8)] == list(range(1, 9))
    assert follower.behind == 2
    publish(writer, count=9)
    assert [frame.number for frame in follower.read(8)] == [19]
    assert (follower.missed, follower.take_missed(), follower.take_missed()) == (10, 10, 0)
    assert [frame.number for frame in patient.read(100)] == list(range(1, 20))
    publish(writer, count=3)
    newest = patient.newest()
    assert newest is not None
    assert (newest.number, patient.behind, patient.missed) == (22, 0, 0)


def test_a_cursor_ends_when_a_retired_block_is_read_to_its_end(segment: Segment, writer: BlockWriter) -> None:
    retired = False
    cursor: Cursor[int] = Cursor(segment.blocks["cell"].ring, lambda fields: fields[0], 0, lambda: retired)
    publish(writer, count=2)
    assert not cursor.ended
    retired = True
    assert not cursor.ended
    assert [cursor.poll(), cursor.poll(), cursor.ended] == [1, 2, True]
