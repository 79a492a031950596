"""The streams of version 2, which carry all topics of a subscriber."""

from __future__ import annotations

import asyncio
from typing import Any

import grpc
import pytest

import shmio
from shmio.endpoints.grpc.server.access import holder_of
from shmio.endpoints.grpc.services import simlog_v2
from shmio.endpoints.grpc.streams import outbox
from shmio.layout.model import Layout
from shmio.segment import Attributes, BlockSpec, Quality, Segment
from shmio.wire import simlog_v2_pb2 as v2
from tests.unit.endpoints.grpc.commands.test_write_subscriptions import accept
from tests.unit.endpoints.grpc.services.test_publish import with_plant
from tests.unit.endpoints.grpc.services.test_simlog_v2 import write
from tests.unit.endpoints.harness import (
    LAYOUT,
    STALE_NS,
    TIMEOUT_S,
    WRITABLE,
    Endpoint,
    image,
    listening,
    message,
    refusal,
    serve,
)
from tests.unit.endpoints.plant import Plant

Status = grpc.StatusCode


async def messages(stream: Any, count: int) -> list[tuple[str, Any]]:
    return [await message(stream) for _ in range(count)]


async def end(stream: Any) -> tuple[grpc.StatusCode, str]:
    """Drain the stream and return how it ended."""
    while True:
        try:
            await message(stream)
        except grpc.aio.AioRpcError as error:
            return error.code(), str(error.details())


async def left(served: Endpoint) -> bool:
    """Return whether all listeners have ended."""
    feed = served.feeds["cell"]
    return await listening(served, 0) and not feed._channels and not feed.commands.write_subscriptions.busy


def test_current_values_come_first_then_every_change_of_all_topics_in_the_order_of_frames(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(position=0.5, inputs=b"\1\2", step=1))
        stream = await served.subscriber("one", "CELL://step/out", "cell/inputs", "axis", "/cell/running")
        assert await messages(stream, 4) == [
            ("CELL://step/out", 1.0),
            ("cell/inputs", [1.0, 2.0]),
            ("axis", {"position": 0.5, "speed": 0.0}),
            ("/cell/running", False),
        ]
        for number in range(2, 6):
            served.publish(image(position=0.5, speed=number, inputs=b"\1\2", step=number))
        served.publish(image(running=True, position=0.5, speed=5, inputs=b"\1\2", step=5))
        got = await messages(stream, 9)
        assert got[-1] == ("/cell/running", True)
        assert [dict(got[at : at + 2]) for at in range(0, 8, 2)] == [
            {"CELL://step/out": number, "axis": {"position": 0.5, "speed": number}} for number in range(2, 6)
        ]
        stream.cancel()
        await served.until(lambda: left(served))

    serve(segment, test)


def test_a_register_subscribed_under_several_paths_is_sent_for_each(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        paths = ["cell/step", "step", "CELL://step", "cell/step/out"]
        streams = [await served.subscriber(uuid, *paths, *paths) for uuid in ("one", "two")]
        assert len(served.feeds["cell"]._channels) == 1
        for stream in streams:
            assert await messages(stream, 4) == [(path, 1.0) for path in paths]
        served.publish(image(step=2))
        for stream in streams:
            assert sorted(await messages(stream, 4)) == sorted((path, 2.0) for path in paths)
            stream.cancel()

    serve(segment, test)


def test_both_versions_are_served_beside_each_other(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        old, new = served.subscribe("cell/step"), await served.subscriber("one", "cell/step")
        for number in (1, 2):
            served.publish(image(step=number))
            assert (await old.read()).value == str(number)
            assert await message(new) == ("cell/step", float(number))
        old.cancel()
        new.cancel()

    serve(segment, test)


def test_no_values_are_sent_while_bad_and_all_again_on_recovery(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1), Quality.BAD)
        stream = await served.subscriber("one", "cell/step", "cell/axis/speed")
        served.publish(image(step=2))
        assert sorted(await messages(stream, 2)) == [("cell/axis/speed", 0.0), ("cell/step", 2.0)]
        served.publish(image(step=3), Quality.BAD)
        served.publish(image(step=2))
        served.publish(image(step=4))
        assert sorted(await messages(stream, 2)) == [("cell/axis/speed", 0.0), ("cell/step", 2.0)]
        assert await message(stream) == ("cell/step", 4.0)
        stream.cancel()

    serve(segment, test)


def test_a_subscriber_of_in_sees_writes_of_all_clients(segment: Segment, instance: str) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        stream = await served.subscriber("one", "CELL://step/in", "cell/axis/in", "cell/inputs/1/in")
        await write(served, "cell/step", 5)
        await write(served, "cell/step", 5)
        await write(served, "cell/inputs", [1, 2])
        await write(served, "cell/axis/speed", 2)  # one member; the other as last written
        with shmio.attach(instance, writable=True) as guest:
            await asyncio.to_thread(guest.write, {"cell/axis/position": 1.5, "cell/axis/speed": 3.0})
            await asyncio.to_thread(guest.write, {"cell/running": True})
        assert await messages(stream, 5) == [
            ("CELL://step/in", 5.0),
            ("CELL://step/in", 5.0),
            ("cell/inputs/1/in", 2.0),
            ("cell/axis/in", {"position": 0.0, "speed": 2.0}),
            ("cell/axis/in", {"position": 1.5, "speed": 3.0}),
        ]
        stream.cancel()

    with_plant(segment, test)


def test_subscribe_may_arrive_before_its_stream(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        early = asyncio.ensure_future(served.add("one", "cell/step"))
        other = await served.subscriber("two")
        stream = await served.subscriber("one")
        await early
        assert await message(stream) == ("cell/step", 1.0)
        stream.cancel()
        other.cancel()

    serve(segment, test)


def test_an_unknown_subscriber_is_not_found(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simlog_v2, "PATIENCE_S", 0.01)

    async def test(served: Endpoint) -> None:
        stream = await served.subscriber("one", "cell/step")
        for uuid in ("", "nobody", "x" * 10_000):
            status, text = await refusal(served.add(uuid, "cell/step"))
            assert status is Status.NOT_FOUND
            assert "unknown subscriber" in text
            assert len(text) < 300
        stream.cancel()
        await served.until(lambda: left(served))
        assert (await refusal(served.add("one", "cell/step")))[0] is Status.NOT_FOUND

    serve(segment, test)


@pytest.mark.parametrize(("name", "uuid"), [("a", ""), ("a", "u" * 257), ("n" * 257, "u")])
def test_an_empty_or_too_long_uuid_or_name_is_refused(segment: Segment, name: str, uuid: str) -> None:
    async def test(served: Endpoint) -> None:
        stream = served.v2.CreateSubscriber(v2.Subscriber(name=name, uuid=uuid), timeout=TIMEOUT_S)
        assert (await refusal(stream.read()))[0] is Status.INVALID_ARGUMENT
        assert await listening(served, 0)

    serve(segment, test)


def test_a_reconnecting_client_replaces_its_earlier_stream(segment: Segment) -> None:
    """A client whose connection broke reconnects before the server notices the loss."""

    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        async with grpc.aio.insecure_channel(f"127.0.0.1:{served.port}") as channel:
            first = await served.subscriber("one", "cell/step", "cell/running")
            assert await message(first) == ("cell/step", 1.0)
            create: Any = channel.unary_stream("/simlog.server.SimlogAPI/CreateSubscriber")
            second = create(v2.Subscriber(name="again", uuid="one").SerializeToString(), timeout=TIMEOUT_S)
            await second.initial_metadata()
            status, text = await end(first)
            assert (status, "again with this uuid" in text) == (Status.ABORTED, True)
            await served.add("one", "cell/step")
            assert v2.SimlogMessage.FromString(await second.read()).value.number_value == 1
            served.publish(image(step=2))
            assert v2.SimlogMessage.FromString(await second.read()).value.number_value == 2
            assert await listening(served, 1)
        await served.until(lambda: left(served))

    serve(segment, test)


@pytest.mark.parametrize(
    ("bound", "text"), [("MAX_TOPICS", "too many subscriptions"), ("MAX_ALL_TOPICS", "too many subscriptions")]
)
def test_the_number_of_topics_is_limited(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, bound: str, text: str
) -> None:
    monkeypatch.setattr(simlog_v2, bound, 2)

    async def test(served: Endpoint) -> None:
        served.publish(image())
        stream = await served.subscriber("one", "cell/step", "cell/running")
        status, found = await refusal(served.add("one", "cell/inputs"))
        assert (status, text in found) == (Status.RESOURCE_EXHAUSTED, True)
        assert await messages(stream, 2) == [("cell/step", 0.0), ("cell/running", False)]
        stream.cancel()

    serve(segment, test)


def test_the_number_of_subscribers_is_limited(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simlog_v2, "MAX_SUBSCRIBERS", 2)

    async def test(served: Endpoint) -> None:
        served.publish(image())
        streams = [await served.subscriber(uuid, "cell/step") for uuid in ("one", "two")]
        third = served.v2.CreateSubscriber(v2.Subscriber(uuid="three"), timeout=TIMEOUT_S)
        assert (await refusal(third.read()))[0] is Status.RESOURCE_EXHAUSTED
        again = await served.subscriber("two", "cell/step")  # takes the place of the existing one
        streams[0].cancel()
        assert await message(again) == ("cell/step", 0.0)
        again.cancel()
        await served.until(lambda: left(served))

    serve(segment, test)


def test_a_thousand_topics_on_one_stream(segment: Segment) -> None:
    elements = [f"cell/long/{number}" for number in range(1, 601)]
    paths = elements + [f"CELL://{path.removeprefix('cell/')}/out" for path in elements[:400]]

    async def test(served: Endpoint) -> None:
        def frame(number: int) -> bytes:
            return image()[:26] + bytes([number]) * 600 + image()[626:]

        served.publish(frame(1))
        stream = await served.subscriber("one")
        await asyncio.gather(*(served.add("one", path) for path in paths))
        assert sorted(await messages(stream, 1000)) == sorted((path, 1.0) for path in paths)
        for number in (2, 3):
            served.publish(frame(number))
            assert sorted(await messages(stream, 1000)) == sorted((path, float(number)) for path in paths)
        assert len(served.feeds["cell"]._channels) == 600
        stream.cancel()
        await served.until(lambda: left(served))
        again = await served.subscriber("two", "cell/step", "cell/long/5")
        assert await messages(again, 2) == [("cell/step", 0.0), ("cell/long/5", 3.0)]
        again.cancel()

    serve(segment, test)


def test_values_are_conflated_for_a_client_that_does_not_read(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outbox, "TOPIC_BOUND", 4)

    async def test(served: Endpoint) -> None:
        def frame(number: int) -> bytes:
            return image(step=number)[:26] + number.to_bytes(2, "big") * 300 + image()[626:]

        served.publish(frame(0))
        deaf = await served.subscriber("deaf", "cell/long", "cell/long/out", "cell/step")
        other = await served.subscriber("other", "cell/step")
        number = 0
        assert await message(other) == ("cell/step", 0.0)

        async def conflated() -> bool:
            nonlocal number
            number += 1
            served.publish(frame(number))
            assert await message(other) == ("cell/step", float(number))
            return served.service.counters[1] > 100

        await served.until(conflated)
        last: dict[str, Any] = {}
        while last.get("cell/step") != number:  # first what was already on its way, then the newest values
            path, value = await message(deaf)
            last[path] = value
        assert (last["cell/long"][:2], last["cell/long/out"][:2]) == ([number >> 8, number & 255],) * 2
        deaf.cancel()
        other.cancel()
        await served.until(lambda: left(served))

    serve(segment, test)


def test_a_client_that_vanishes_without_reading_leaves_nothing(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image())
        async with grpc.aio.insecure_channel(f"127.0.0.1:{served.port}") as channel:
            create: Any = channel.unary_stream("/simlog.server.SimlogAPI/CreateSubscriber")
            stream = create(v2.Subscriber(uuid="gone").SerializeToString())
            await stream.initial_metadata()
            await served.add("gone", "cell/long")
            await served.add("gone", "cell/long/in")
            number = 0

            async def full() -> bool:
                nonlocal number
                number += 1
                served.publish(image()[:26] + number.to_bytes(2, "big") * 300 + image()[626:])
                await asyncio.sleep(0)
                return served.service.counters[1] > 100

            await served.until(full)
        await served.until(lambda: left(served))

    serve(segment, test)


def test_a_client_that_does_not_read_writes_loses_its_stream(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "EVENT_BOUND", 8)

    async def test(served: Endpoint) -> None:
        served.publish(image())
        stream = await served.subscriber("one", "cell/step/in", "cell/running")
        for number in range(2, 40):  # without a turn of the event loop
            accept(served, number, 12, bytes([0, number]))
        assert await message(stream) == ("cell/running", False)
        status, text = await end(stream)
        assert status is Status.RESOURCE_EXHAUSTED
        assert text.startswith("cell/step/in: 8 messages are waiting")
        await served.until(lambda: left(served))

    serve(segment, test)


def test_a_deadline_or_a_cancelled_call_ends_one_stream(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        hasty = served.v2.CreateSubscriber(v2.Subscriber(uuid="hasty"), timeout=0.05)
        stream = await served.subscriber("one", "cell/step")
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await hasty.read()
        assert caught.value.code() is Status.DEADLINE_EXCEEDED
        for number in range(20):
            served.v2.CreateSubscriber(v2.Subscriber(uuid=str(number)), timeout=TIMEOUT_S).cancel()
            served.v2.Subscribe(v2.SubscriptionRequest(path="cell/step", subscriberUUID="one")).cancel()
        await served.until(lambda: listening(served, 1))
        assert await message(stream) == ("cell/step", 1.0)
        stream.cancel()

    serve(segment, test)


def test_a_structure_too_large_for_a_message_is_refused(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.services.simlog_v2.MAX_MEMBERS", 1)

    async def test(served: Endpoint) -> None:
        stream = await served.subscriber("one")
        status, text = await refusal(served.add("one", "cell/axis"))
        assert (status, "too many for one value" in text) == (Status.INVALID_ARGUMENT, True)
        stream.cancel()

    serve(segment, test)


def test_topics_survive_a_reload_and_removed_registers_resume_when_they_return(segment: Segment) -> None:
    fewer = Layout("DB1", 1, LAYOUT.size, False, LAYOUT.registers[:4])

    def change(served: Endpoint, layout: Layout) -> None:
        """Replace the source's feed, as :meth:`Feeds.follow` does."""
        spec = BlockSpec("cell", layout, 10_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE[:1]))
        segment.change(retire=["cell"], add=[spec])
        old = served.feeds["cell"]
        served.feeds["cell"] = type(old)(segment.blocks["cell"], 4, served.wake_ups, lambda *_: None)
        served.feeds["cell"].start()
        served.service.on_sources_replaced(["cell"])
        assert not old._channels
        old.stop()
        served.writer = segment.writer("cell")

    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        stream = await served.subscriber("one", "cell/step", "cell/axis", "cell/axis/speed/in")
        assert len(await messages(stream, 2)) == 2
        change(served, fewer)
        served.publish(image(speed=2, step=2))
        assert await message(stream) == ("cell/axis", {"position": 0.0, "speed": 2.0})
        change(served, LAYOUT)
        served.publish(image(speed=3, step=3))
        assert await messages(stream, 2) == [("cell/step", 3.0), ("cell/axis", {"position": 0.0, "speed": 3.0})]
        stream.cancel()
        await served.until(lambda: left(served))

    serve(segment, test)


def test_a_uuid_belongs_to_its_client(segment: Segment) -> None:
    """Other clients can neither end its stream nor add topics to it. A token identifies the client."""
    first, other = (("authorization", "Bearer one"),), (("authorization", "Bearer other"),)
    subscriber, topic = v2.Subscriber(name="a", uuid="a"), v2.SubscriptionRequest(path="cell/step", subscriberUUID="a")

    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        stream = served.v2.CreateSubscriber(subscriber, metadata=first, timeout=TIMEOUT_S)
        await stream.initial_metadata()
        rude = served.v2.CreateSubscriber(subscriber, metadata=other, timeout=TIMEOUT_S)
        status, text = await refusal(rude.read())
        assert (status, "belongs to another client" in text) == (Status.ALREADY_EXISTS, True)
        for metadata in (other, ()):
            status, text = await refusal(served.v2.Subscribe(topic, metadata=metadata, timeout=TIMEOUT_S))
            assert (status, "unknown subscriber" in text) == (Status.NOT_FOUND, True)
        await served.v2.Subscribe(topic, metadata=first, timeout=TIMEOUT_S)
        assert await message(stream) == ("cell/step", 1)
        again = served.v2.CreateSubscriber(subscriber, metadata=first, timeout=TIMEOUT_S)
        await again.initial_metadata()
        assert (await end(stream))[0] is Status.ABORTED
        again.cancel()

    serve(segment, test)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("ipv4:10.0.0.1:5000", "ipv4:10.0.0.1:5001", True),
        ("ipv4:10.0.0.1:5000", "ipv6:%5B::ffff:10.0.0.1%5D:5001", True),
        ("ipv4:10.0.0.1:5000", "ipv4:10.0.0.2:5000", False),
        ("ipv4:127.0.0.1:5000", "ipv6:%5B::1%5D:5001", True),
        ("unix:", "ipv4:127.0.0.1:5000", True),
        ("unix:", "ipv4:10.0.0.1:5000", False),
    ],
)
def test_without_a_token_a_client_is_recognised_by_its_host(one: str, other: str, same: bool) -> None:
    assert (holder_of(one, (), None) == holder_of(other, (), None)) is same
    assert holder_of(one, (("authorization", "Bearer x"),), None) != holder_of(one, (), None)
    assert holder_of(one, (), {"x509_common_name": [b"a"]}) == holder_of(other, (), {"x509_common_name": [b"a"]})
