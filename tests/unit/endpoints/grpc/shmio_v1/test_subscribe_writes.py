"""Subscriptions of shmio.v1 to ``/in``: every accepted write, in the source's order."""

from __future__ import annotations

import asyncio
from typing import Any

import grpc
import pytest

from shmio.client import connect_aio
from shmio.endpoints.grpc.streams import outbox
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, EventKind, ProcessSpec, Segment
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.endpoints.grpc.services.test_publish import message, publish, with_plant
from tests.unit.endpoints.grpc.shmio_v1.harness import Stream, stub, subscribe
from tests.unit.endpoints.grpc.shmio_v1.test_write import write
from tests.unit.endpoints.harness import STALE_NS, TIMEOUT_S, Endpoint, refusal
from tests.unit.endpoints.plant import Plant
from tests.unit.endpoints.stepped import Model, simulate

Status = grpc.StatusCode


async def told(stream: Stream, count: int) -> list[dict[str, Any]]:
    return [await stream.values() for _ in range(count)]


async def joined(stream: Stream) -> Any:
    table = await stream.next()
    assert table.direction == wire.DIRECTION_IN
    return table


def test_writes_arrive_in_order_as_soon_as_accepted(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        stream = subscribe(served, "cell/axis/in", "cell/step/in", "cell/inputs/in", "cell/running/in", "cell/name/in")
        table = await joined(stream)
        await write(served, {"cell/step": 5, "cell/axis/speed": 2.0}, until_accepted=True)
        await write(served, {"cell/inputs/1": 7}, until_accepted=True)
        await write(served, {"cell/long/5": 7}, until_accepted=True)  # not subscribed
        await write(served, {"cell/running": True, "cell/name": "ab"}, until_accepted=True)
        await write(served, {"cell/step": 5}, until_accepted=True)  # an equal write is reported again
        assert await told(stream, 6) == [
            {"step": 5},
            {"axis/speed": 2.0},
            {"inputs": {1: 7}},
            {"running": True},
            {"name": "ab"},
            {"step": 5},
        ]
        assert table.source == "cell"
        assert not device.written

    with_plant(segment, test, running=False)


def test_writes_of_version_1_clients_are_included(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        stream = subscribe(served, "cell/step/in")
        await joined(stream)
        await publish(served, [message("cell/step/in", str(number)) for number in range(300)])
        assert await told(stream, 300) == [{"step": number} for number in range(300)]

    with_plant(segment, test)


def test_in_and_out_on_one_stream(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        async with (
            connect_aio(f"127.0.0.1:{served.port}") as cell,
            cell.subscribe("cell/step", "cell/step/in") as stream,
        ):
            assert (await anext(stream)).table.direction == "out"
            await cell.write({"cell/step": 9})
            seen: dict[str, Any] = {}
            while seen != {"in": 9, "out": 9}:
                update = await anext(stream)
                seen[update.table.direction] = update["cell/step"]

    with_plant(segment, test)


def test_long_texts_arrive_whole(instance: str) -> None:
    """The source reports a long text in parts."""
    layout = Layout("L", 1, 1024, False, (Register("texts", "STRING[100]", ((0, 9),), 2, None, 1020, 10),))
    block = BlockSpec("cell", layout, 20_000_000, STALE_NS, 1 << 20, Attributes("test", ("**",)))
    texts = [chr(65 + index) * 100 for index in range(10)]

    async def test(served: Endpoint, _: Plant) -> None:
        stream = subscribe(served, "cell/texts/in")
        await joined(stream)
        await write(served, {"cell/texts": texts})
        found: dict[int, str] = {}
        while len(found) < 10:
            part = (await stream.values())["texts"]
            assert not set(part) & set(found)
            found |= part
        assert [found[index] for index in range(10)] == texts

    with Segment.create(instance, [block], [ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]) as segment:
        with_plant(segment, test)
        segment.unlink()


def test_a_write_before_a_step_comes_before_its_marker(instance: str) -> None:
    async def test(served: Endpoint, _: dict[str, Model]) -> None:
        call = stub(served).Subscribe(wire.SubscribeRequest(patterns=["sim/goal/in"]), timeout=TIMEOUT_S)
        assert (await call.read()).tables
        for number in range(1, 20):
            await write(served, {"sim/goal": number}, until_accepted=True)
            made = await stub(served).Step(wire.StepRequest(), timeout=TIMEOUT_S)
            got: list[Any] = []
            while not any(one.HasField("step") for one in got):
                got.append(await call.read())
            assert [value for one in got for update in one.updates for value in update.values.int32s.values] == [number]
            assert got[-1].step.number == made.step
        call.cancel()

    simulate(instance, test)


def test_a_reload_is_followed(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        stream = subscribe(served, "cell/step/in", "cell/step")
        tables = [await stream.next(), await stream.next()]
        assert {table.direction for table in tables} == {wire.DIRECTION_IN, wire.DIRECTION_OUT}
        feed = served.feeds.pop("cell")
        served.service.on_sources_replaced(["cell"])
        ends: list[Any] = []
        while len(ends) < 2:
            if isinstance(found := await stream.next(), wire.Ended):
                ends.append(found)
        assert {(end.source, end.direction) for end in ends} == {("cell", 0), ("cell", 1)}
        assert not feed.commands.followers.busy
        served.feeds["cell"] = feed
        served.service.on_sources_replaced(["cell"])
        while not isinstance(await stream.next(), wire.Table):
            pass
        await write(served, {"cell/step": 8})
        while await stream.values() != {"step": 8}:
            pass

    with_plant(segment, test)


def test_a_slow_clients_stream_ends_with_the_reason(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "MAX_WAITING", 8)

    async def test(served: Endpoint, _: Plant) -> None:
        stream = subscribe(served, "cell/step/in")
        await joined(stream)
        feed, events = served.feeds["cell"], segment.blocks["cell"].events
        await write(served, {"cell/step": 1})
        await stream.update()
        head = events.head()
        (accepted,) = (one for at in range(1, head + 1) if (one := events.read(at)) and one.kind == EventKind.ACCEPTED)
        for number in range(head + 1, head + 21):  # without a turn of the event loop, so that nothing is read
            feed.commands.followers.follow(accepted._replace(number=number))
        code, text = await refusal(drain(stream))
        assert code is Status.RESOURCE_EXHAUSTED
        assert "messages are waiting" in text
        assert not feed.commands.followers.busy

    with_plant(segment, test)


async def drain(stream: Stream) -> None:
    while True:
        await asyncio.wait_for(stream.next(), TIMEOUT_S)


def test_missed_events_end_the_stream(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        stream = subscribe(served, "cell/step/in")
        await joined(stream)
        served.feeds["cell"].commands.followers.fail("3 events of source cell were missed")
        assert await refusal(drain(stream)) == (Status.RESOURCE_EXHAUSTED, "3 events of source cell were missed")

    with_plant(segment, test)


def test_unsupported_subscriptions_are_refused(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        frames = subscribe(served, "cell/in", format=wire.FORMAT_FRAMES)
        assert (await refusal(frames.next()))[0] is Status.INVALID_ARGUMENT
        nothing = subscribe(served, "cell/nothing/in")
        assert (await refusal(nothing.next()))[0] is Status.NOT_FOUND
        assert not served.feeds["cell"].commands.followers.busy

    with_plant(segment, test)
