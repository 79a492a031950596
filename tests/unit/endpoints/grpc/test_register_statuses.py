"""What clients of gRPC see of a source that gives each register a status."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest

from shmio.client import connect, connect_aio
from shmio.connectors.register_image import RegisterImage
from shmio.endpoints.grpc.encoding import Subject, unless_bad
from shmio.endpoints.grpc.shmio_v1.subscribe import BlockUpdates, EveryFrame, LatestFrame
from shmio.endpoints.grpc.shmio_v1.tables import Selection
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN, UNCERTAIN_LAST_USABLE_VALUE
from shmio.model.values import Quality
from shmio.segment import BlockWriter, EventKind, Record, Segment
from shmio.segment import Quality as FrameQuality
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wire import simlog_v2_pb2 as v2
from tests.unit.endpoints.grpc.test_grpc import Recorder
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, message, serve
from tests.unit.endpoints.plant import Plant
from tests.unit.statuses import COUNT, LAMP, LAYOUT, ROW, SOURCE_NS, SPEED, first_image, plant


def served(instance: str, test: Callable[[Endpoint, BlockWriter], Awaitable[None]]) -> None:
    with plant(instance) as (segment, writer):
        serve(segment, lambda endpoint: test(endpoint, writer))


async def text(stream: Any) -> str:
    return str((await asyncio.wait_for(stream.read(), TIMEOUT_S)).value)


def test_version_1_does_not_send_a_bad_register_and_sends_it_again_when_it_is_good(instance: str) -> None:
    async def test(endpoint: Endpoint, writer: BlockWriter) -> None:
        image = first_image()
        writer.publish(bytes(image), cycle=1)
        speed, count = endpoint.subscribe("plant/speed"), endpoint.subscribe("plant/count")
        assert (await text(speed), await text(count)) == ("1.5", "1")
        image.put(SPEED, 9.5, SOURCE_NS, BAD_NODE_ID_UNKNOWN)
        image.put(COUNT, 2)
        writer.publish(bytes(image), cycle=2)
        assert await text(count) == "2"
        image.put(SPEED, 1.5, SOURCE_NS, UNCERTAIN_LAST_USABLE_VALUE)
        writer.publish(bytes(image), cycle=3)
        assert await text(speed) == "1.5"

    served(instance, test)


def test_version_2_reads_null_for_a_bad_register_and_streams_only_good_values(instance: str) -> None:
    async def test(endpoint: Endpoint, writer: BlockWriter) -> None:
        image = first_image()
        image.fail(SPEED, BAD_NODE_ID_UNKNOWN)
        writer.publish(bytes(image), cycle=1)
        stream = await endpoint.subscriber("one", "plant/speed", "plant/count")
        assert await message(stream) == ("plant/count", 1.0)
        request = v2.ReadRequest(path=["plant/speed", "plant/count"])
        found = (await endpoint.v2.Read(request, timeout=TIMEOUT_S)).messages
        assert [one.value.WhichOneof("kind") for one in found] == ["null_value", "number_value"]
        image.put(SPEED, 2.5)
        writer.publish(bytes(image), cycle=2)
        assert await message(stream) == ("plant/speed", 2.5)

    served(instance, test)


def test_a_client_of_shmio_v1_sees_that_a_register_has_no_value_yet(instance: str) -> None:
    async def test(endpoint: Endpoint, writer: BlockWriter) -> None:
        image = RegisterImage(LAYOUT)
        image.put(COUNT, 3, SOURCE_NS)
        writer.publish(bytes(image), cycle=1)
        async with connect_aio(f"127.0.0.1:{endpoint.port}") as client:
            speed, count = await client.get("plant/speed", "plant/count")
            assert (speed.value, speed.quality, speed.source_time) == (None, Quality.BAD, None)
            assert "no data yet" in speed.reason
            assert count.value == 3

    served(instance, test)


def test_a_client_of_shmio_v1_gets_status_reason_time_and_unit(instance: str) -> None:
    async def test(endpoint: Endpoint, writer: BlockWriter) -> None:
        image = first_image()
        image.fail(SPEED, BAD_NODE_ID_UNKNOWN, SOURCE_NS + 7)
        writer.publish(bytes(image), cycle=1)
        async with connect_aio(f"127.0.0.1:{endpoint.port}") as client:
            (layout,) = (await client.layouts()).values()
            assert (layout.status_offset, layout.size) == (LAYOUT.status_offset, LAYOUT.size)
            assert layout.registers[SPEED].unit == "mm/s"
            update = (await client.read("plant")).of("plant/speed")
            quality, reason = update.quality_of("speed")
            assert (quality, reason) == (Quality.BAD, "the device reports BadNodeIdUnknown (0x80340000)")
            readings = {reading.register.path: reading for reading in update.readings}
            assert {path: one.quality for path, one in readings.items() if path != "speed"} == dict.fromkeys(
                ("count", "row", "lamp"), Quality.GOOD
            )
            assert readings["speed"].source_time == (SOURCE_NS + 7) / 1e9
            assert readings["lamp"].source_time == (SOURCE_NS + 3) / 1e9

    served(instance, test)


def test_a_stream_of_shmio_v1_sends_changed_statuses_alone(instance: str) -> None:
    async def test(endpoint: Endpoint, writer: BlockWriter) -> None:
        image = first_image()
        writer.publish(bytes(image), cycle=1)
        async with (
            connect_aio(f"127.0.0.1:{endpoint.port}") as client,
            client.subscribe("plant") as updates,
            asyncio.timeout(TIMEOUT_S),
        ):
            first = await anext(updates)
            assert [one.quality for one in first.readings] == [Quality.GOOD] * 4
            image.put(COUNT, 1, SOURCE_NS + 50)  # only its time: no update
            writer.publish(bytes(image), cycle=2)
            image.fail(SPEED, BAD_NODE_ID_UNKNOWN)
            writer.publish(bytes(image), cycle=3)
            update = await anext(updates)
            assert (update.cycle, update.changes) == (3, ())
            readings = {reading.register.path: reading for reading in update.readings}
            assert readings["speed"].quality is Quality.BAD
            assert readings.get("count", first.readings[COUNT]).quality is Quality.GOOD
            image.put(SPEED, 1.5, SOURCE_NS + 60)
            writer.publish(bytes(image), cycle=4)
            update = await anext(updates)
            (reading,) = update.readings
            assert (reading.quality, reading.source_time) == (Quality.GOOD, (SOURCE_NS + 60) / 1e9)

    served(instance, test)


def test_a_value_written_to_a_bad_register_is_shown_on_in(instance: str) -> None:
    async def test(endpoint: Endpoint, writer: BlockWriter) -> None:
        image = first_image()
        image.fail(COUNT, BAD_NODE_ID_UNKNOWN)
        writer.publish(bytes(image), cycle=1)
        stream = endpoint.subscribe("plant/count/in")
        await stream.initial_metadata()
        writer.event(Record(EventKind.ACCEPTED, "", 7, 1, 0, 1, 0, 0, 2, b"\x05\0"))
        assert await text(stream) == "5"

    served(instance, test)


def test_a_value_that_waits_in_a_stream_is_dropped_when_its_register_turns_bad(instance: str) -> None:
    async def test(endpoint: Endpoint, writer: BlockWriter) -> None:
        image = first_image()
        feed = endpoint.feeds["plant"]
        registers = (LAYOUT.registers[SPEED],)
        speed = Subject("raw", "speed", registers, unless_bad(lambda one: one.image, registers, LAYOUT))
        stream = Recorder()
        feed.listen(speed, stream)
        writer.publish(bytes(image), cycle=1)

        async def delivered() -> bool:
            return bool(stream.got)

        async def dropped() -> bool:
            return stream.lost == 1

        await endpoint.until(delivered)
        image.fail(SPEED, BAD_NODE_ID_UNKNOWN)
        writer.publish(bytes(image), cycle=2)
        await endpoint.until(dropped)
        feed.leave(speed, stream)

    served(instance, test)


@pytest.fixture
def source(instance: str) -> Iterator[tuple[Segment, BlockWriter]]:
    with plant(instance) as found:
        yield found


def selection(segment: Segment) -> Selection:
    return Selection(1, segment.blocks["plant"], LAYOUT.registers)


def times(update: bytes | None) -> dict[int, int]:
    """Return the source times in an update by register index, without the part that all of them share."""
    assert update is not None
    found = wire.Update.FromString(update).statuses
    return {place: time - SOURCE_NS for place, time in zip(found.registers, found.source_ns, strict=True)}


@pytest.mark.parametrize("deadband", [0.0, 0.1])
def test_a_time_that_changed_alone_comes_with_the_next_update(
    source: tuple[Segment, BlockWriter], deadband: float
) -> None:
    segment, writer = source
    updates, image = LatestFrame(selection(segment), 0.0, deadband), first_image()
    writer.publish(bytes(image), cycle=1)
    assert times(updates.next(0.0)) == {COUNT: 0, SPEED: 1, ROW: 2, LAMP: 3}
    image.put(COUNT, 1, SOURCE_NS + 50)
    writer.publish(bytes(image), cycle=2)
    assert updates.next(0.0) is None
    image.put(LAMP, False, SOURCE_NS + 60)
    writer.publish(bytes(image), cycle=3)
    assert times(updates.next(0.0)) == {COUNT: 50, LAMP: 60}
    image.put(ROW, [1, 2, 3, 4], SOURCE_NS + 70)
    writer.publish(bytes(image), cycle=4)
    assert updates.next(0.0) is None
    image.put(SPEED, 1.5, SOURCE_NS + 80, UNCERTAIN_LAST_USABLE_VALUE)
    writer.publish(bytes(image), cycle=5)
    assert times(updates.next(0.0)) == {ROW: 70, SPEED: 80}


def test_an_update_about_the_source_has_the_times_that_changed_alone(source: tuple[Segment, BlockWriter]) -> None:
    segment, writer = source
    updates, image = LatestFrame(selection(segment), 0.0, 0.0), first_image()
    writer.publish(bytes(image), cycle=1)
    updates.next(0.0)
    image.put(COUNT, 1, SOURCE_NS + 50)
    writer.publish(bytes(image), cycle=2, quality=FrameQuality.UNCERTAIN, reason="STOP")
    assert times(updates.next(0.0)) == {COUNT: 50}


def test_each_of_all_frames_has_the_times_that_changed(source: tuple[Segment, BlockWriter]) -> None:
    segment, writer = source
    updates, image = EveryFrame(selection(segment)), first_image()
    for cycle in range(1, 4):
        writer.publish(bytes(image), cycle=cycle)
        image.put(COUNT, 1, SOURCE_NS + 10 * cycle)
    assert [times(updates.next(0.0)) for _ in range(3)] == [
        {COUNT: 0, SPEED: 1, ROW: 2, LAMP: 3},
        {COUNT: 10},
        {COUNT: 20},
    ]


def test_subscribers_with_different_rates_get_the_same_times(source: tuple[Segment, BlockWriter]) -> None:
    segment, writer = source
    view, image = selection(segment), first_image()
    fast, slow = LatestFrame(view, 0.0, 0.0), LatestFrame(view, 10.0, 0.0)
    subscribers: tuple[tuple[BlockUpdates, dict[int, int]], ...] = ((fast, {}), (slow, {}))

    def deliver(now_s: float) -> None:
        for updates, known in subscribers:
            if update := updates.next(now_s):
                known.update(times(update))

    for cycle in range(1, 30):
        image.put(COUNT, 1, SOURCE_NS + cycle)
        if cycle % 5 == 0:
            image.put(SPEED, float(cycle), SOURCE_NS + cycle)
        writer.publish(bytes(image), cycle=cycle)
        deliver(cycle / 2)
    image.put(LAMP, False, SOURCE_NS + 99)
    writer.publish(bytes(image), cycle=30)
    deliver(100.0)
    assert [known for _, known in subscribers] == [{COUNT: 29, SPEED: 25, ROW: 2, LAMP: 99}] * 2


def test_originals_of_an_injection_have_their_statuses(instance: str) -> None:
    async def test(endpoint: Endpoint, writer: BlockWriter) -> None:
        image = first_image()
        image.put(SPEED, 1.5, SOURCE_NS + 7, UNCERTAIN_LAST_USABLE_VALUE)
        device = Plant(writer, allow_nonfinite=())
        device.memory[:] = bytes(image)
        device.cycle()
        device.run()

        def call() -> None:
            with (
                connect(f"127.0.0.1:{endpoint.port}", timeout_s=TIMEOUT_S) as client,
                client.inject("plant/speed", "plant/count", originals=True) as shadow,
            ):
                update = next(shadow)
                first = {reading.register.path: reading for reading in update.readings}
                speed, count = first["speed"], first["count"]
                assert (speed.value, speed.quality) == (1.5, Quality.UNCERTAIN)
                assert speed.source_time == (SOURCE_NS + 7) / 1e9
                assert (count.value, count.quality, count.source_time) == (1, Quality.GOOD, SOURCE_NS / 1e9)
                shadow.set({"plant/speed": 100.0})
                image.fail(SPEED, BAD_NODE_ID_UNKNOWN, SOURCE_NS + 8)  # the value stays as it was
                device.memory[:] = bytes(image)
                (speed,) = next(shadow).readings
                assert (speed.quality, speed.source_time) == (Quality.BAD, (SOURCE_NS + 8) / 1e9)
                assert "BadNodeIdUnknown" in speed.reason
                image.put(COUNT, 1, SOURCE_NS + 9)  # only its time
                device.memory[:] = bytes(image)
                cycles = device.cycles
                while device.cycles < cycles + 3:
                    client.read("plant")
                image.put(SPEED, 2.5, SOURCE_NS + 10)
                device.memory[:] = bytes(image)
                readings = {reading.register.path: reading for reading in next(shadow).readings}
                assert (readings["speed"].value, readings["speed"].quality) == (2.5, Quality.GOOD)
                assert readings["count"].source_time == (SOURCE_NS + 9) / 1e9

        try:
            await asyncio.to_thread(call)
        finally:
            device.stop()

    served(instance, test)
