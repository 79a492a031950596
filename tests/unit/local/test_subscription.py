"""Local subscriptions in situations that a running cell does not reliably produce."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from shmio.errors import ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.local.attach import Attachment, attach
from shmio.local.subscription import Subscription
from shmio.model.values import Quality
from shmio.segment import BlockSpec, BlockWriter, Segment, Stamp, block

LAYOUT = Layout("DB1", 1, 4, False, (Register("a", "INT", (), 0, None, 2, 1), Register("b", "INT", (), 2, None, 2, 1)))
LONG_NS = 3600 * 10**9


def spec(source: str, stale_ns: int = LONG_NS) -> BlockSpec:
    return BlockSpec(source, LAYOUT, 20_000_000, stale_ns, 1 << 16)


def publish(writer: BlockWriter, cycle: int, a: int, b: int) -> None:
    writer.publish(a.to_bytes(2, "big") + b.to_bytes(2, "big"), cycle=cycle)


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with Segment.create(instance, [spec("cell"), spec("press"), spec("tired", 300_000_000)], []) as segment:
        yield segment
        segment.unlink()


@pytest.fixture
def cell(segment: Segment) -> Iterator[Attachment]:
    with attach(segment.instance) as cell:
        yield cell


@pytest.mark.parametrize(
    ("patterns", "options"),
    [((), {}), (("cell/a",), {"max_rate_hz": -1.0}), (("cell/a",), {"max_rate_hz": 5.0, "every_frame": True})],
)
def test_local_subscription_refuses_what_an_endpoint_refuses(
    cell: Attachment, patterns: tuple[str, ...], options: dict[str, Any]
) -> None:
    with cell.subscribe(*patterns, **options) as updates, pytest.raises(ValueRangeError):
        next(updates)


def test_slow_reader_gets_the_changes_up_to_the_newest_frame(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    publish(writer, 1, 1, 1)
    with cell.subscribe("cell") as updates:
        assert [one.value for one in next(updates).readings] == [1, 1]
        for cycle in range(2, 10):
            publish(writer, cycle, 1, cycle)
        update = next(updates)
        assert (update.cycle, [(one.path, one.value) for one in update.readings]) == (9, [("cell/b", 9)])


def test_every_frame_comes_and_lost_ones_are_counted(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("cell")
    publish(writer, 1, 1, 1)
    with cell.subscribe("cell/a", every_frame=True) as updates:
        next(updates)
        publish(writer, 2, 1, 1)
        assert next(updates).readings == (), "a frame in which nothing has changed"
        for cycle in range(3, 3 + 2 * writer.block.ring.slot_count):
            publish(writer, cycle, 2, 2)
        update = next(updates)
        assert (update.missed > 0, update.frame) == (True, 3 + update.missed)


def test_sources_take_turns(segment: Segment, cell: Attachment) -> None:
    writers = [segment.writer(source) for source in ("cell", "press")]
    for writer in writers:
        publish(writer, 1, 1, 1)
    with cell.subscribe("cell/a", "press/a", every_frame=True) as updates:
        for cycle in range(2, 5):
            for writer in writers:
                publish(writer, cycle, cycle, 1)
        found = [(update.source, update.cycle) for update in (next(updates) for _ in range(8))]
    assert sorted(found[:2]) == [("cell", 1), ("press", 1)]
    assert sorted(found) == sorted((source, cycle) for source in ("cell", "press") for cycle in range(1, 5))


def test_a_source_that_falls_silent_is_bad(segment: Segment, cell: Attachment) -> None:
    publish(segment.writer("tired"), 1, 1, 1)
    with cell.subscribe("tired/a") as updates:
        while (update := next(updates)).quality is not Quality.BAD:
            pass
    assert update.reason.startswith("stale")
    assert [(one.value, one.quality) for one in update.readings] == [(1, Quality.BAD)]


def test_a_source_whose_next_update_is_not_due_is_not_stale(
    segment: Segment, cell: Attachment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block, "CLOCK_RESOLUTION_NS", 2 * LONG_NS)  # so that a frame may stay good
    writer = segment.writer("tired")
    publish(writer, 1, 1, 1)
    with cell.subscribe("tired/a", max_rate_hz=1) as updates:
        next(updates)
        later = Stamp(time.monotonic_ns() + LONG_NS, 0, time.time_ns())  # this frame stays good
        writer.publish(bytes(4), cycle=2, at=later)
        update = next(updates)
    assert (update.cycle, update.quality) == (2, Quality.GOOD)


def test_late_frames_have_the_quality_of_their_own_time(segment: Segment, cell: Attachment) -> None:
    writer = segment.writer("tired")
    publish(writer, 1, 1, 1)
    with cell.subscribe("tired/a", every_frame=True) as updates:
        next(updates)
        writer.publish(bytes(4), cycle=2, asked_ns=time.monotonic_ns() - 60 * 10**9)
        publish(writer, 3, 1, 1)
        update = next(updates)
        while update.cycle < 2:  # the first frame may become stale before the second comes
            update = next(updates)
    assert (update.cycle, update.quality, update.readings[0].quality) == (2, Quality.GOOD, Quality.GOOD)


def test_reload_ends_removed_sources_and_continues_changed_ones(segment: Segment, cell: Attachment) -> None:
    for source in ("cell", "press"):
        publish(segment.writer(source), 1, 1, 1)
    with cell.subscribe("cell/b", "press/b") as updates:
        assert {next(updates).source, next(updates).source} == {"cell", "press"}
        segment.change(add=[spec("cell")], retire=["cell", "press"])
        publish(segment.writer("cell"), 1, 5, 6)
        after = {update.source: update for update in (next(updates), next(updates))}
    assert [(one.path, one.value) for one in after["cell"].readings] == [("cell/b", 6)]
    assert (after["press"].ended, after["press"].readings) == (True, ())
    assert "source 'press' was removed" in after["press"].reason


def test_a_subscription_that_is_dropped_leaves_no_thread(segment: Segment, cell: Attachment) -> None:
    publish(segment.writer("cell"), 1, 1, 1)
    for _ in cell.subscribe("cell/a"):
        assert relays()
        break
    gc.collect()
    assert not relays()


def relays() -> list[str]:
    """Return the names of the threads that wake subscriptions."""
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("following-")]


def test_subscription_during_a_close_by_another_thread_is_over(
    segment: Segment, cell: Attachment, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(segment.writer("cell"), 1, 1, 1)

    def overtaken(*arguments: Any, **options: Any) -> Subscription:
        subscription = Subscription(*arguments, **options)
        cell.close()
        return subscription

    monkeypatch.setattr("shmio.local.subscription.Subscription", overtaken)
    assert list(cell.subscribe("cell")) == []
    assert not [thread for thread in threading.enumerate() if thread.name == "following-cell"]
