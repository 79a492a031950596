"""Feeds of an instance whose configuration is reloaded."""

from __future__ import annotations

import asyncio
import gc
import threading
import weakref

import pytest

from shmio.endpoints.grpc import wakeups as ringing
from shmio.endpoints.grpc.encoding import Subject
from shmio.endpoints.grpc.streams import back_pressure
from shmio.endpoints.grpc.streams.feed import Feeds, Moment, VirtualTime
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.segment import Attributes, BlockSpec, Quality, Segment
from tests.unit.endpoints.grpc.test_grpc import STEP, Recorder
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, TIMEOUT_S, WRITABLE, WRITER, image
from tests.unit.endpoints.stepped import LAYOUT as MODEL_LAYOUT
from tests.unit.endpoints.stepped import stepped_segment


def test_a_replaced_feed_is_dropped_when_its_streams_have_left(segment: Segment, instance: str) -> None:
    async def run(opened: Segment) -> None:
        wake_ups = WakeUps()
        feeds = Feeds(opened, WRITER, wake_ups, lambda source, good: None)
        feeds.start()
        old = feeds["cell"]
        stream = Recorder()
        old.listen(STEP, stream)
        segment.writer("cell").publish(image(step=1), cycle=1)
        async with asyncio.timeout(TIMEOUT_S):
            while not feeds.messages:  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(0)
        counted = feeds.messages
        spec = BlockSpec("cell", LAYOUT, 10_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
        segment.change(retire=["cell"], add=[spec])
        async with asyncio.timeout(TIMEOUT_S):
            while feeds["cell"] is old:
                await feeds.follow()
                await asyncio.sleep(0)
        await feeds.follow()
        assert old in feeds._ended  # a stream has not moved to the new feed yet
        old.leave(STEP, stream)
        gone = weakref.ref(old)
        del old
        async with asyncio.timeout(TIMEOUT_S):
            while gone() is not None:
                await feeds.follow()
                await asyncio.sleep(0)
                gc.collect()
        assert feeds.messages == counted
        assert feeds.alive
        feeds.stop()
        wake_ups.close()

    with Segment.open(instance, writable=True) as opened:
        asyncio.run(run(opened))


def test_the_event_loop_runs_while_a_new_layout_is_read(segment: Segment, instance: str) -> None:
    """A thread other than the event loop's reads the segment."""

    async def run(opened: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
        wake_ups = WakeUps()
        feeds = Feeds(opened, WRITER, wake_ups, lambda source, good: None)
        feeds.start()
        await feeds.follow()
        going_on, begun, refresh = threading.Event(), asyncio.Event(), opened.refresh
        loop = asyncio.get_running_loop()

        def slow() -> bool:
            loop.call_soon_threadsafe(begun.set)
            assert going_on.wait(TIMEOUT_S)
            return refresh()

        monkeypatch.setattr(opened, "refresh", slow)
        spec = BlockSpec("second", LAYOUT, 10_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
        segment.change(add=[spec])
        following = asyncio.create_task(feeds.follow())
        async with asyncio.timeout(TIMEOUT_S):
            await begun.wait()
            assert list(feeds) == ["cell"]
            going_on.set()
            assert await following == ["second"]
        assert list(feeds) == ["cell", "second"]
        feeds.stop()
        wake_ups.close()

    with Segment.open(instance, writable=True) as opened, pytest.MonkeyPatch.context() as monkeypatch:
        asyncio.run(run(opened, monkeypatch))


COUNT = Subject("raw", "count", (MODEL_LAYOUT.registers[0],), lambda picture: bytes((picture.number, picture.image[3])))


def test_a_model_replaced_by_a_reload_in_virtual_time_is_shown_step_by_step(instance: str) -> None:
    async def run(opened: Segment) -> None:
        wake_ups, virtual_time = WakeUps(), VirtualTime()
        virtual_time.on, virtual_time.moment = True, Moment(6, 0)
        feeds = Feeds(opened, WRITER, wake_ups, lambda source, good: None, virtual_time)
        feeds.start()
        attributes = Attributes("simulation", ("goal",), stepped=True)
        spec = BlockSpec("sim", MODEL_LAYOUT, 10_000_000, STALE_NS, 1 << 20, attributes)
        opened.change(retire=["sim"], add=[spec])
        await feeds.follow()
        stream = Recorder()
        feeds["sim"].listen(COUNT, stream)
        writer = opened.writer("sim")
        for count in (1, 2, 3):
            writer.publish(b"\0\0\0" + bytes([count]) + bytes(MODEL_LAYOUT.size - 4), cycle=count)
            async with asyncio.timeout(TIMEOUT_S):
                while not stream.got:  # noqa: ASYNC110  another thread changes it
                    await asyncio.sleep(0)
        assert stream.got == [bytes((6, 1))], "the first image only, until a step"
        for number in (7, 8):
            virtual_time.moment = Moment(number, 0)
            feeds["sim"].step()
        assert stream.got == [bytes((6, 1)), bytes((7, 3))]
        feeds["sim"].leave(COUNT, stream)
        feeds.stop()
        wake_ups.close()

    with stepped_segment(instance, "sim") as segment:
        asyncio.run(run(segment))


def test_a_held_feed_skips_no_frames(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The feed gives the frames to its streams later, so no stream counts as slow."""
    monkeypatch.setattr(back_pressure, "LOOK_S", 1000.0)
    monkeypatch.setattr(ringing, "PAUSE_S", 0.001)

    async def run(opened: Segment) -> None:
        told, wake_ups = list[bool](), WakeUps()
        feeds = Feeds(opened, WRITER, wake_ups, lambda _, good: told.append(good))
        feeds.start()
        feed, stream, writer = feeds["sim"], Recorder(), opened.writer("sim")
        feed.listen(COUNT, stream)
        writer.publish(bytes(MODEL_LAYOUT.size), cycle=1)
        async with asyncio.timeout(TIMEOUT_S):
            while told[-1:] != [True]:  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(0)
            feed.suspend()
            for cycle in range(2, 2 * back_pressure.CATCH_UP_FRAMES):
                writer.publish(bytes(MODEL_LAYOUT.size), cycle=cycle)
            writer.publish(bytes(MODEL_LAYOUT.size), cycle=2 * back_pressure.CATCH_UP_FRAMES, quality=Quality.BAD)
            while told[-1]:  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(0)
        assert stream.stream.dropped == 0
        feed.leave(COUNT, stream)
        feeds.stop()
        wake_ups.close()

    with stepped_segment(instance, "sim", virtual=False) as segment:
        asyncio.run(run(segment))
