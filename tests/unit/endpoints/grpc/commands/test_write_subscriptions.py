"""Subscriptions to ``/in``: every accepted write, in the source's order."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import grpc
import pytest

import shmio
from shmio.local.writer import CommandSender
from shmio.segment import EventKind, Record, Segment, Write
from shmio.segment.events import EVENT_SLOTS
from tests.unit.endpoints.grpc.services.test_publish import message, publish
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, endpoint, image, listening, serve, value
from tests.unit.endpoints.plant import Plant

FAR_NS = 10**18


def with_plant(segment: Segment, test: Callable[[Endpoint, Plant], Awaitable[None]]) -> None:
    async def run() -> None:
        async with endpoint(segment) as served:
            device = Plant(served.writer)
            try:
                device.cycle()
                device.run()
                await test(served, device)
            finally:
                device.stop()

    asyncio.run(run())


async def joined(served: Endpoint, *paths: str) -> list[Any]:
    """Open streams that receive every later write."""
    streams = [served.subscribe(path) for path in paths]
    for stream in streams:
        await stream.initial_metadata()
    return streams


def test_a_subscriber_of_in_sees_writes_of_all_clients(segment: Segment, instance: str) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        (stream,) = await joined(served, "cell/step/in")
        await publish(served, [message("cell/step", "5"), message("cell/step", "5"), message("cell/inputs/0", "1")])
        with shmio.attach(instance, writable=True) as guest:
            await asyncio.to_thread(guest.write, {"cell/step": -6})
        assert [await value(stream) for _ in range(3)] == ["5", "5", "-6"]
        first = await served.stub.GetTopic(message("cell/step/in").topic)
        assert first.msgType == "int"
        stream.cancel()
        await served.until(lambda: listening(served, 0))
        assert served.feeds["cell"].commands.write_subscriptions._channels == {}

    with_plant(segment, test)


def test_the_message_has_type_and_time(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        (stream,) = await joined(served, "cell/axis/position/in")
        before = served.segment.clock_ns(0)
        await publish(served, [message("cell/axis/position", "1.0E-4", kind="whatever")])
        got = await stream.read()
        assert (got.type, got.value) == ("double", "0.0001")
        assert got.timeStamp.stamp.nsec > before
        assert got.timeStamp.seq > 0
        stream.cancel()

    with_plant(segment, test)


def test_writing_a_bit_is_not_shown_for_its_neighbours(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        running, bit, other = await joined(served, "cell/running/in", "cell/bits/9/in", "cell/bits/8/in")
        await publish(served, [message("cell/running", "true"), message("cell/bits/9", "true")])
        await publish(served, [message("cell/running", "false"), message("cell/bits/8", "true")])
        assert [await value(running), await value(running)] == ["true", "false"]
        assert (await value(bit), await value(other)) == ("true", "true")
        await publish(served, [message("cell/bits", str([0] * 10))])
        assert (await value(bit), await value(other)) == ("false", "false")
        for stream in (running, bit, other):
            stream.cancel()

    with_plant(segment, test)


def test_element_and_array_subscribers_see_each_others_writes(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        array, element = await joined(served, "cell/inputs/in", "cell/inputs/1/in")
        await publish(served, [message("cell/inputs", "[1,2]")])
        assert (await value(array), await value(element)) == ("[1,2]", "2")
        await publish(served, [message("cell/inputs/1", "7")])
        assert (await value(array), await value(element)) == ("[1,7]", "7")
        await publish(served, [message("cell/inputs/0", "9")])
        assert await value(array) == "[9,7]"
        await publish(served, [message("cell/inputs/1", "8")])
        assert await value(element) == "8"
        for stream in (array, element):
            stream.cancel()

    with_plant(segment, test)


def accept(served: Endpoint, command: int, offset: int, data: bytes, *, item: int = 0) -> None:
    """Publish an event for a part of an accepted write, as a source does."""
    served.writer.event(Record(EventKind.ACCEPTED, "", 7, command, item, 1, offset, 0, len(data), data))


def test_a_long_write_is_shown_once_and_whole(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image())
        array, element = await joined(served, "cell/long/in", "cell/long/300/in")
        for number in range(1, 21):
            for offset, size in ((26, 256), (282, 256), (538, 88)):
                accept(served, number, offset, bytes([number]) * size)
                served.publish(image(step=number))  # published during the write and after it
        shown = [await value(array) for _ in range(20)]
        assert [set(text.strip("[]").split(",")) for text in shown] == [{str(number)} for number in range(1, 21)]
        assert [await value(element) for _ in range(20)] == [str(number) for number in range(1, 21)]
        for stream in (array, element):
            stream.cancel()

    serve(segment, test)


def test_a_subscriber_that_joins_during_a_write_sees_only_the_next_one(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        events = served.feeds["cell"].commands._events

        async def heard() -> bool:
            return events.behind == 0

        served.publish(image())
        accept(served, 1, 26, b"\1" * 256)
        await served.until(heard)
        (array,) = await joined(served, "cell/long/in")
        accept(served, 1, 282, b"\1" * 256)
        accept(served, 1, 538, b"\1" * 88)
        accept(served, 2, 27, b"\2")
        accept(served, 3, 12, b"\0\0")
        assert (await value(array))[:7] == "[0,2,0,"
        array.cancel()

    serve(segment, test)


async def end(stream: Any) -> tuple[list[str], grpc.aio.AioRpcError]:
    """Return the remaining values, and the error that ends the stream."""
    values: list[str] = []
    while True:
        try:
            values.append(await value(stream))
        except grpc.aio.AioRpcError as error:
            return values, error


def test_missed_events_end_the_stream(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image())
        step, array = await joined(served, "cell/step/in", "cell/long/in")
        accept(served, 2, 26, b"\1" * 256)  # no listener receives it
        for number in range(2 * EVENT_SLOTS):  # without a turn of the event loop
            accept(served, 3, 282, bytes([number % 256]) * 256)
        for stream in (step, array):
            values, error = await end(stream)
            assert values == []
            assert error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
            assert "events of source cell were missed" in str(error.details())
        await served.until(lambda: listening(served, 0))
        (again,) = await joined(served, "cell/long/in")
        accept(served, 3, 538, b"\1" * 88)  # belongs to a command whose first part it missed
        accept(served, 4, 28, b"\4")
        accept(served, 5, 12, b"\0\0")
        assert (await value(again))[:7] == "[0,0,4,"
        again.cancel()

    serve(segment, test)


def test_a_slow_listeners_stream_ends_with_the_reason(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.streams.outbox.EVENT_BOUND", 8)

    async def test(served: Endpoint) -> None:
        served.publish(image())
        slow, other = await joined(served, "cell/step/in", "cell/inputs/in")
        for number in range(2, 40):  # without a turn of the event loop
            accept(served, number, 12, bytes([0, number]))
        accept(served, 40, 10, b"\5\6")
        values, error = await end(slow)
        assert values == [str(number) for number in range(2, 2 + len(values))]
        assert error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert error.details() == "cell/step/in: 8 messages are waiting: the client reads too slowly"
        assert await value(other) == "[5,6]"
        assert served.service.counters[1] > 0
        other.cancel()

    serve(segment, test)


def test_a_burst_arrives_whole_and_in_order(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        streams = await joined(served, "cell/step/in", "cell/step/in")
        block = served.feeds["cell"].block
        sender, events = CommandSender(block, 7), block.events.cursor()
        for number in range(400):  # without a turn of the event loop
            command = sender.submit([Write(12, 0, number.to_bytes(2, "big"))], FAR_NS)
            while (event := events.next(TIMEOUT_S)) is not None and event.command != command:
                pass
            assert event is not None
        for stream in streams:
            assert [await value(stream) for _ in range(400)] == [str(number) for number in range(400)]
            stream.cancel()

    with_plant(segment, test)


def test_several_partial_writes_in_one_command_are_one_value(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        array, word = await joined(served, "cell/long/in", "cell/step/in")
        sender = CommandSender(served.feeds["cell"].block, 7)
        sender.submit([Write(26, 0, b"\1"), Write(28, 0, b"\3"), Write(12, 0, b"\0"), Write(13, 0, b"\4")], FAR_NS)
        assert (await value(array))[:7] == "[1,0,3,"
        assert await value(word) == "4"
        sender.submit(
            [Write(25, 0, b"\0\5"), Write(24, 0, b"\0")], FAR_NS
        )  # also covers a part of the preceding register
        assert (await value(array))[:7] == "[5,0,3,"
        for stream in (array, word):
            stream.cancel()

    with_plant(segment, test)


def test_rejected_writes_are_not_shown(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        (stream,) = await joined(served, "cell/step/in")
        device.commands.close("away")
        await publish(served, [message("cell/step", "1")])
        device.commands.open()
        await publish(served, [message("cell/step", "2")])
        assert await value(stream) == "2"
        stream.cancel()

    with_plant(segment, test)


def test_a_subscriber_of_out_sees_the_read_value_not_the_written_one(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        out, plain = served.subscribe("cell/step/out"), served.subscribe("cell/step")
        assert (await value(out), await value(plain)) == ("0", "0")
        device.refusal = "locked"
        await publish(served, [message("cell/step", "1")])
        device.refusal = ""
        await publish(served, [message("cell/step", "2")])
        assert (await value(out), await value(plain)) == ("2", "2")
        assert device.memory[12:14] == image(step=2)[12:14]
        for stream in (out, plain):
            stream.cancel()

    with_plant(segment, test)
