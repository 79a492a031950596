"""Back-pressure: a feed reads only the frames that its streams can take."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import closing

import pytest

from shmio.endpoints.grpc import wakeups
from shmio.endpoints.grpc.streams import back_pressure, outbox
from shmio.endpoints.grpc.streams.back_pressure import BEHIND_S, WINDOW_S, LossMonitor
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import Outbox, StateLane
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Quality, Segment
from shmio.segment import block as block_module
from shmio.segment.block import Stamp
from tests.unit.endpoints.grpc.test_grpc import STEP
from tests.unit.endpoints.harness import LAYOUT, SOON_STALE_NS, STALE_NS, TIMEOUT_S, WRITABLE, WRITER, image

MANY = 300
STEPS = 2**15
"""Number of values that the register `step`, an INT, can count from 0.

A fast host publishes more frames in one test.
"""


class Known(LossMonitor):
    """A loss monitor whose result the test sets."""

    def __init__(self, *, behind: bool) -> None:
        super().__init__()
        self.behind = behind

    def offer(self, now_s: float) -> None: ...


class Followed:
    """A feed, its source, and streams of one register; each stream has received its first value."""

    def __init__(self, segment: Segment, *behind: bool, source: str = "cell") -> None:
        self.writer = segment.writer(source)
        self._wake_ups = WakeUps()
        self.told = list[bool]()
        self.feed = Feed(segment.blocks[source], WRITER, self._wake_ups, lambda _, good: self.told.append(good))
        self.count = 0
        self.feed.start()
        self.streams = [Outbox() for _ in behind]
        for stream, late in zip(self.streams, behind, strict=True):
            stream.losses = Known(behind=late)
            StateLane(stream).join(self.feed, STEP)

    async def begin(self) -> None:
        asking = [asyncio.ensure_future(self.next(stream)) for stream in self.streams]  # before any frame is skipped
        await self.publish(1)
        assert [await value for value in asking] == [1] * len(asking)

    async def publish(self, count: int) -> None:
        """Publish frames with the next numbers, and give the streams time to show or skip each."""
        for _ in range(count):
            self.count += 1
            self.writer.publish(image(step=self.count % STEPS), cycle=self.count)
            await self.pass_by()

    async def fail(self) -> None:
        """Publish a frame of bad quality, which has no values."""
        self.count += 1
        self.writer.publish(image(), cycle=self.count, quality=Quality.BAD, reason="cable out")
        await self.pass_by()

    async def pass_by(self) -> None:
        for _ in range(3):
            await asyncio.sleep(0)

    async def next(self, stream: Outbox) -> int:
        async with asyncio.timeout(TIMEOUT_S):
            message = await stream.pop()
        assert message is not None
        return int.from_bytes(message, "big")

    def stop(self) -> None:
        self.feed.stop()
        self._wake_ups.close()


def follow(segment: Segment, test: Callable[[Followed], Awaitable[None]], *behind: bool) -> None:
    async def run() -> None:
        followed = Followed(segment, *behind)
        try:
            await followed.begin()
            await test(followed)
        finally:
            followed.stop()

    asyncio.run(run())


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Never look for stale frames, count every frame as late, and let feeds sleep until they are woken."""
    monkeypatch.setattr(back_pressure, "LOOK_S", 1000.0)
    monkeypatch.setattr(back_pressure, "LATE_S", 0.0)
    monkeypatch.setattr(wakeups, "PAUSE_S", 1000.0)


def test_frames_that_no_stream_can_take_are_not_read(segment: Segment) -> None:
    async def test(followed: Followed) -> None:
        feed, (first, second) = followed.feed, followed.streams
        before = feed.messages
        await followed.publish(MANY)
        assert feed.messages == before
        assert await followed.next(first) == MANY + 1, "the newest value when the stream asks"
        assert await followed.next(second) == MANY + 1
        assert feed.messages == before + 1
        assert first.dropped == second.dropped == MANY - 1
        await followed.publish(1)
        waiting = asyncio.ensure_future(followed.next(first))
        assert await waiting == MANY + 2
        waiting = asyncio.ensure_future(followed.next(first))
        await asyncio.sleep(0)
        await followed.publish(1)
        assert await waiting == MANY + 3, "a waiting stream is woken"

    follow(segment, test, True, True)


def test_a_stream_far_behind_gets_the_few_newest_frames(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (back_pressure, outbox):
        monkeypatch.setattr(module, "LATE_S", 1000.0)

    async def test(followed: Followed) -> None:
        (stream,) = followed.streams
        await followed.publish(MANY)
        last = MANY + 1
        expected = range(last - back_pressure.FEW_FRAMES + 1, last + 1)
        assert [await followed.next(stream) for _ in expected] == list(expected)

    follow(segment, test, True)


def test_a_stream_that_is_briefly_busy_misses_nothing(segment: Segment) -> None:
    async def test(followed: Followed) -> None:
        (stream,) = followed.streams
        before = followed.feed.messages
        await followed.publish(back_pressure.CATCH_UP_FRAMES)
        assert followed.feed.messages == before, "frames are not read until the stream asks"
        expected = range(2, back_pressure.CATCH_UP_FRAMES + 2)
        assert [await followed.next(stream) for _ in expected] == list(expected)
        assert stream.dropped == 0
        await followed.publish(back_pressure.CATCH_UP_FRAMES + 1)
        assert await followed.next(stream) == 2 * (back_pressure.CATCH_UP_FRAMES + 1)
        assert stream.dropped == back_pressure.CATCH_UP_FRAMES

    follow(segment, test, False)


def test_every_frame_is_read_if_one_stream_keeps_up(segment: Segment) -> None:
    async def test(followed: Followed) -> None:
        late, good = followed.streams
        for number in range(2, 40):
            waiting = asyncio.ensure_future(followed.next(good))
            await followed.publish(1)
            assert await waiting == number
        assert await followed.next(late) <= 39

    follow(segment, test, True, False)


def test_frames_are_read_in_time_though_no_stream_asks(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(back_pressure, "LOOK_S", 0.0)

    async def test(followed: Followed) -> None:
        before = followed.feed.messages
        async with asyncio.timeout(TIMEOUT_S):
            while followed.feed.messages < before + 20:
                await followed.publish(1)

    follow(segment, test, True)


def test_a_stream_of_several_sources_gets_the_newest_of_each(instance: str) -> None:
    blocks = [BlockSpec(name, LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE)) for name in "ab"]
    processes = [*(ProcessSpec(name, "source") for name in "ab"), ProcessSpec("grpc", "grpc")]

    async def run(segment: Segment) -> None:
        a = Followed(segment, False, source="a")
        (stream,) = a.streams
        b = Followed(segment, source="b")
        StateLane(stream).join(b.feed, STEP)
        try:
            await a.publish(1)
            await b.publish(1)
            assert [await a.next(stream) for _ in range(2)] == [1, 1]
            for number in range(2, 10):
                await b.publish(1)
                await a.publish(1)
                async with asyncio.timeout(TIMEOUT_S):
                    while len(stream.refills) < 2:  # noqa: ASYNC110  another thread changes it
                        await asyncio.sleep(0)
                assert [await a.next(stream) for _ in range(2)] == [number, number], "one value of each source"
        finally:
            a.stop()
            b.stop()

    with Segment.create(instance, blocks, processes) as segment:
        with closing(segment):
            asyncio.run(run(segment))
        segment.unlink()


def test_a_stream_that_joins_a_resting_feed_can_wake_it(segment: Segment) -> None:
    async def test(followed: Followed) -> None:
        await followed.publish(1)  # skipped, as the existing stream does not ask
        async with asyncio.timeout(TIMEOUT_S):
            while not followed.streams[0].refills:  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(0)
        late = Outbox()
        StateLane(late).join(followed.feed, STEP)
        await followed.publish(2)
        assert await followed.next(late) == 2, "the value at the time of joining"
        assert [await followed.next(late) for _ in range(2)] == [3, 4]

    follow(segment, test, False)


def test_a_stream_that_has_left_no_longer_wakes_its_feed(segment: Segment) -> None:
    """Frames that no other stream can take are not read for a stream that has left."""

    async def test(followed: Followed) -> None:
        feed, (stream,) = followed.feed, followed.streams
        gone = Outbox()
        leave = StateLane(gone).join(feed, STEP)
        await followed.publish(1)  # skipped, as neither stream asks
        async with asyncio.timeout(TIMEOUT_S):
            while not (gone.refills and stream.refills):  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(0)
        leave()
        before = feed.messages
        assert await followed.next(gone) == 1, "the value that it was given before"
        asking = asyncio.ensure_future(followed.next(gone))
        await asyncio.sleep(0)
        assert feed.messages == before
        asking.cancel()
        assert await followed.next(stream) == 2

    follow(segment, test, False)


def test_a_resting_feed_notices_a_failed_source_without_a_ring(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wakeups, "TURN_NS", 1_000_000_000_000)
    monkeypatch.setattr(wakeups, "PAUSE_S", 0.001)

    async def test(followed: Followed) -> None:
        passes, heard = followed.feed._back_pressure.passes, asyncio.Event()

        def passed() -> bool:
            heard.set()
            return passes()

        monkeypatch.setattr(followed.feed._back_pressure, "passes", passed)
        await followed.fail()
        async with asyncio.timeout(TIMEOUT_S):
            await heard.wait()
        assert followed.told == [True], "the failure has not been noticed yet"
        monkeypatch.setattr(back_pressure, "LOOK_S", 0.0)
        followed.feed._back_pressure._until_s = 0.0
        async with asyncio.timeout(TIMEOUT_S):
            while followed.told == [True]:  # noqa: ASYNC110  the stream has no doorbell of its own
                await asyncio.sleep(0)
        assert followed.told == [True, False]

    follow(segment, test, False)


def test_skipped_frames_do_not_make_a_source_stale(soon_stale: Segment) -> None:
    async def test(followed: Followed) -> None:
        (stream,) = followed.streams
        begun_s = asyncio.get_running_loop().time()
        while asyncio.get_running_loop().time() < begun_s + 1.5e-9 * SOON_STALE_NS:
            await followed.publish(1)
        await followed.publish(MANY)
        assert await followed.next(stream) == followed.count % STEPS
        assert followed.told == [True]

    follow(soon_stale, test, True)


def test_a_gap_between_two_frames_read_at_once_counts_as_stale(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The publication time of the next frame counts, not the time at which the feed read it."""
    monkeypatch.setattr(block_module, "CLOCK_RESOLUTION_NS", 10 * STALE_NS)  # its frame comes too early

    async def test(followed: Followed) -> None:
        (stream,), block = followed.streams, segment.blocks["cell"]
        asking = asyncio.ensure_future(followed.next(stream))
        await followed.pass_by()
        late = Stamp(block.now_ns() + 2 * STALE_NS, 0)
        followed.writer.publish(image(step=followed.count), cycle=followed.count + 1, at=late)
        assert await asking == followed.count, "the unchanged value is sent again"
        assert followed.told == [True, False, True]

    follow(segment, test, False)


def far_behind(now_s: float) -> LossMonitor:
    """Return a monitor of a client that loses most of its values."""
    losses = LossMonitor()
    losses.offer(now_s - WINDOW_S)
    losses.lose(1)
    losses.offer(now_s)
    assert losses.behind
    return losses


def test_all_streams_far_behind_are_retried_together() -> None:
    together_s = 7 * BEHIND_S
    monitors = [far_behind(together_s - before_s) for before_s in (0.9 * BEHIND_S, 0.4 * BEHIND_S, 0.001)]
    for now_s, behind in ((together_s - 0.0005, True), (together_s, False)):
        for losses in monitors:
            losses.offer(now_s)
        assert [losses.behind for losses in monitors] == [behind] * 3


def test_values_that_were_never_queued_count_as_lost() -> None:
    losses = LossMonitor()
    losses.offer(100.0)
    losses.skip(3)
    losses.offer(100.0 + WINDOW_S)
    assert losses.behind
