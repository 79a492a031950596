"""A source that gives each register a status, as clients of gRPC see it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from shmio.client import connect_aio
from shmio.endpoints.grpc.encoding import Subject, unless_bad
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN, UNCERTAIN_LAST_USABLE_VALUE
from shmio.model.values import Quality
from shmio.segment import BlockWriter, EventKind, Record
from shmio.wire import simlog_v2_pb2 as v2
from tests.unit.endpoints.grpc.test_grpc import Recorder
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, message, serve
from tests.unit.statuses import COUNT, LAYOUT, SOURCE_NS, SPEED, first_image, plant


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
