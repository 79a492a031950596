"""Clients that disconnect, stop half-way, send garbage or never read leave nothing behind."""

from __future__ import annotations

import asyncio
from typing import Any

import grpc
import pytest

from shmio.endpoints.grpc.server.server import MAX_REQUEST_BYTES
from shmio.endpoints.grpc.shmio_v1.subscribe import MAX_STREAMS
from shmio.endpoints.grpc.streams import outbox
from shmio.endpoints.grpc.streams.back_pressure import BOUND_BYTES
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as ours
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from tests.unit.endpoints import http2
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, message, value
from tests.unit.endpoints.rude import (
    CALLS,
    HEALTH,
    NOISE,
    OURS,
    V1,
    V2,
    Call,
    Polite,
    begin,
    beside_a_polite_client,
    connect,
    status,
)

Status = grpc.StatusCode
NARROW = http2.frame(http2.SETTINGS, 0, 0, b"\0\4\0\0\1\0")
"""Flow-control window that lets only 256 bytes of an unread stream be sent."""


async def until_calls(served: Endpoint, count: int) -> None:
    async def reached() -> bool:
        await asyncio.sleep(0)
        return len(served.server.calls) >= count

    await served.until(reached)


@pytest.mark.parametrize("reset", [False, True], ids=["end", "reset"])
@pytest.mark.parametrize("stage", ["headers", "part of the prefix", "part of the message", "message", "half-close"])
def test_connections_break_at_each_stage_of_each_call(segment: Segment, stage: str, reset: bool) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        for call in CALLS:
            whole = http2.message(call.request)
            sent = {"headers": 0, "part of the prefix": 3, "part of the message": len(whole) - 1}.get(stage, len(whole))
            connection = await http2.Connection.open(served.port)
            await connection.send(http2.headers(call.method))
            end = http2.END_STREAM if stage == "half-close" else 0
            if sent:
                # An incomplete frame is discarded as a whole; a complete frame may hold part of a message.
                await connection.send(http2.frame(http2.DATA, end, 1, whole[:sent]))
            if sent < len(whole) or (call.stays and not end):
                await until_calls(served, 3)
            else:
                async with asyncio.timeout(TIMEOUT_S):
                    await connection.reader.read(1)  # the server has started to answer, or acknowledged our settings
            await connection.drop(reset=reset)
            await polite.alone()

    beside_a_polite_client(segment, test)


@pytest.mark.parametrize(
    "data",
    [b"", b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01\0\xff" * 50, http2.PREFACE[:10], http2.PREFACE + b"\xff" * 500],
)
def test_bytes_that_are_not_http2_do_not_disturb_others(segment: Segment, data: bytes) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", served.port)
        writer.write(data)
        await writer.drain()
        writer.write_eof()
        async with asyncio.timeout(TIMEOUT_S):
            await reader.read()
        writer.close()
        await polite.goes_on()

    beside_a_polite_client(segment, test)


def test_calls_cancelled_before_during_and_after_their_message(segment: Segment) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        async with connect(served) as channel:
            for call in CALLS:
                at_once = begin(channel, call)
                at_once.cancel()
                silent = begin(channel, call)
                await until_calls(served, 3)
                silent.cancel()
                await polite.alone()
                answered = begin(channel, call)
                await answered.write(call.request)
                if call.stays:
                    await until_calls(served, 3)
                answered.cancel()
                await polite.alone()

    beside_a_polite_client(segment, test)


def test_half_closed_calls_end_or_continue_as_specified(segment: Segment) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        async with connect(served) as channel:
            for call in CALLS:
                empty = begin(channel, call)
                await empty.done_writing()
                good = call.many and not call.first
                assert await status(empty) is (Status.OK if good else Status.INVALID_ARGUMENT), call.method
                whole = begin(channel, call)
                await whole.write(call.request)
                await whole.done_writing()
                if call.stays and not call.many:
                    await until_calls(served, 3)
                    whole.cancel()
                else:
                    assert await status(whole) is call.ends, call.method
                await polite.alone(connected=True)

    beside_a_polite_client(segment, test)


def test_calls_end_at_their_deadline(segment: Segment) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        async with connect(served) as channel:
            for call in CALLS:
                late = begin(channel, call, 0.02)
                assert await status(late) is Status.DEADLINE_EXCEEDED
                if call.stays:
                    late = begin(channel, call, 0.05)
                    await late.write(call.request)
                    assert await status(late) is Status.DEADLINE_EXCEEDED
                await polite.alone()

    beside_a_polite_client(segment, test)


@pytest.mark.parametrize("size", [9, MAX_REQUEST_BYTES + 1], ids=["garbage", "oversize"])
def test_undecodable_bytes_end_only_their_call(segment: Segment, size: int) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        refused = 0
        async with connect(served) as channel:
            for call in CALLS:
                stream = begin(channel, call)
                await stream.write(b"\xff" * size)
                await stream.done_writing()
                told = await status(stream)
                if size > MAX_REQUEST_BYTES:
                    assert told is Status.RESOURCE_EXHAUSTED, call.method
                elif call.method.endswith("Publish"):  # an invalid message does not end the stream
                    assert told is Status.OK
                    refused += 1
                else:
                    assert told is Status.INVALID_ARGUMENT, call.method
                await polite.alone()
        assert served.service.counters[3] == refused

    beside_a_polite_client(segment, test)


@pytest.mark.parametrize("version", [1, 2])
def test_a_subscriber_that_never_reads_has_a_bounded_queue(segment: Segment, version: int) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        connection = await http2.Connection.open(served.port)
        if version == 1:
            call = Call(V1 + "Subscribe", v1.TopicDescriptor(path="cell/long").SerializeToString())
        else:
            call = Call(V2 + "CreateSubscriber", v2.Subscriber(name="deaf", uuid="deaf").SerializeToString())
        await connection.send(http2.call(call.method, call.request))
        if version == 2:
            await served.add("deaf", "cell/long")
        before = served.service.counters[1]
        for number in range(600):  # fills its connection, then its queue, and more
            polite.device.memory[30:32] = number.to_bytes(2, "big")
            await polite.goes_on()
            if served.service.counters[1] > before:
                break
        assert served.service.counters[1] > before, "values were dropped for this subscriber only"
        assert 0 < served.service.waiting_bytes < BOUND_BYTES
        await connection.drop(reset=True)

    beside_a_polite_client(segment, test)


def test_a_health_watcher_that_never_reads_delays_no_other(segment: Segment) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        connection = await http2.Connection.open(served.port)
        watch = next(call for call in CALLS if call.method == HEALTH + "Watch")
        await connection.send(http2.call(watch.method, watch.request))
        await until_calls(served, 3)
        async with asyncio.timeout(TIMEOUT_S):
            for number in range(20_000):
                await served.server.set_source("cell", number % 2 == 0)
        assert await served.health("source.cell") == 2
        await connection.drop(reset=True)

    beside_a_polite_client(segment, test)


def test_a_thousand_subscriptions_on_one_stream(segment: Segment) -> None:
    forms = [form + "long/{}" + end for form in ("cell/", "CELL://") for end in ("", "/out")]
    paths = [form.format(index) for form in forms for index in range(1, 601)][:1000]

    async def test(served: Endpoint, polite: Polite) -> None:
        stream = await served.subscriber("many", *paths)
        assert {(await message(stream))[0] for _ in paths} == set(paths)
        polite.device.memory[26:626] = bytes([1]) * 600
        assert sorted([(await message(stream))[0] for _ in paths]) == sorted(paths)
        await polite.goes_on()
        stream.cancel()

    beside_a_polite_client(segment, test)


def test_a_thousand_streams_on_one_connection(segment: Segment) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        async with connect(served) as channel:
            subscribe: Any = channel.unary_stream(V1 + "Subscribe", None, v1.ROSMessage.FromString)
            requests = [
                v1.TopicDescriptor(path=f"cell/long/{index % 600 + 1}").SerializeToString() for index in range(1000)
            ]
            streams = [subscribe(request, timeout=TIMEOUT_S) for request in requests]
            assert {await value(stream) for stream in streams} == {"0"}
            polite.device.memory[26:626] = bytes([1]) * 600
            assert {await value(stream) for stream in streams} == {"1"}
            await polite.goes_on()

    beside_a_polite_client(segment, test)


def test_fifty_short_lived_clients_do_not_disturb_others(segment: Segment) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        over = asyncio.Event()

        async def come_and_go(number: int) -> None:
            uuid = f"guest {number}"
            for turn in range(3):
                async with connect(served) as channel:
                    subscribe: Any = channel.unary_stream(V1 + "Subscribe")
                    stream = subscribe(CALLS[1].request, timeout=TIMEOUT_S)
                    await stream.read()
                    create = begin(channel, Call(V2 + "CreateSubscriber", b""))
                    await create.write(v2.Subscriber(name="guest", uuid=uuid).SerializeToString())
                    await create.initial_metadata()
                    await served.add(uuid, "cell/inputs")
                    await create.read()
                    if (number + turn) % 3 == 0:
                        stream.cancel()
                    elif (number + turn) % 3 == 1:
                        await create.done_writing()  # in the remaining case the connection closes with both calls

        async def read() -> int:
            count = 0
            while not over.is_set():
                await polite.goes_on()
                count += 1
            return count

        reading = asyncio.create_task(read())
        await asyncio.gather(*(come_and_go(number) for number in range(50)))
        over.set()
        assert await reading > 0

    beside_a_polite_client(segment, test)


@pytest.mark.parametrize("direction", ["", "/in"])
def test_shmio_v1_streams_beyond_the_limit_are_refused_until_others_end(segment: Segment, direction: str) -> None:
    request = ours.SubscribeRequest(patterns=[f"cell/long{direction}"]).SerializeToString()

    async def test(served: Endpoint, polite: Polite) -> None:
        async with connect(served) as channel:
            subscribe: Any = channel.unary_stream(OURS + "Subscribe")
            streams = [subscribe(request, timeout=TIMEOUT_S) for _ in range(MAX_STREAMS + 40)]
            await until_streams(served, 2 + MAX_STREAMS)
            refused = [stream for stream in streams if await first(stream) is grpc.aio.EOF]
            assert len(refused) == 40
            assert {await stream.code() for stream in refused} == {Status.RESOURCE_EXHAUSTED}
            await polite.goes_on()
        await until_streams(served, 2)
        async with connect(served) as channel:
            subscribe = channel.unary_stream(OURS + "Subscribe")
            assert await first(subscribe(request, timeout=TIMEOUT_S)) is not grpc.aio.EOF

    beside_a_polite_client(segment, test)


async def first(stream: Any) -> Any:
    """Return the first message of a stream; EOF if the stream is refused."""
    try:
        return await stream.read()
    except grpc.aio.AioRpcError:
        return grpc.aio.EOF


async def until_streams(served: Endpoint, count: int) -> None:
    async def reached() -> bool:
        await asyncio.sleep(0)
        return served.service.counters[0] == count

    await served.until(reached)


def test_a_shmio_v1_subscriber_that_never_reads_delays_no_other(segment: Segment) -> None:
    """For such a client the endpoint stores only its position, and writes only up to a limit."""
    both = ours.SubscribeRequest(patterns=["cell/long", "cell/long/in"], mode=ours.MODE_EVERY_FRAME)

    async def test(served: Endpoint, polite: Polite) -> None:
        connection = await http2.Connection.open(served.port)
        await connection.send(NARROW)
        await connection.send(http2.call(OURS + "Subscribe", both.SerializeToString()))
        await until_streams(served, 3)
        long = ours.Assignment(path="cell/long", value=ours.Value(list=ours.List(values=[ours.Value(integer=1)] * 600)))
        put = ours.WriteRequest(values=[long]).SerializeToString()
        async with connect(served) as channel:
            write: Any = channel.unary_unary(OURS + "Write")
            for _ in range(2000):
                await write(put, timeout=TIMEOUT_S)
                if not served.feeds["cell"].commands.followers.busy:
                    break
        assert not served.feeds["cell"].commands.followers.busy, "its stream was ended"
        await polite.goes_on()
        await connection.drop(reset=True)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(outbox, "MAX_WAITING", 64)
        beside_a_polite_client(segment, test)


@pytest.mark.parametrize("call", ["Inject", "Declare"])
def test_a_client_that_does_not_read_its_injections_events_loses_it(segment: Segment, call: str) -> None:
    """The injection ends. Otherwise the stream would wait for the client as long as the connection exists."""
    lay = ours.InjectRequest(lay=ours.Lay(patterns=["cell/inputs/in"]))
    request: Any = lay if call == "Inject" else ours.DeclareRequest(declarations=[NOISE])
    put = ours.WriteRequest(values=[ours.Assignment(path="cell/inputs/0", value=ours.Value(integer=1))])

    async def test(served: Endpoint, polite: Polite) -> None:
        connection = await http2.Connection.open(served.port)
        await connection.send(NARROW)
        await connection.send(http2.headers(OURS + call))
        await connection.send(http2.frame(http2.DATA, 0, 1, http2.message(request.SerializeToString())))
        injections = segment.blocks["cell"].injections

        async def laid() -> bool:
            await asyncio.sleep(0)
            return bool(injections.read())

        await served.until(laid)
        async with connect(served) as channel:
            write: Any = channel.unary_unary(OURS + "Write")
            for _ in range(20_000):
                if call == "Inject":
                    await write(put.SerializeToString(), timeout=TIMEOUT_S)
                else:
                    await polite.goes_on()  # one odd and one even step
                if not injections.read():
                    break
        assert not injections.read()
        await connection.drop(reset=True)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(outbox, "MAX_WAITING", 16)
        beside_a_polite_client(segment, test)


def test_unknown_topics_and_invalid_values_are_refused(segment: Segment) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        wrong = "cell/nothing/in"
        nothing = v1.TopicDescriptor(path=wrong)
        async with connect(served) as channel:

            async def ends(method: str, *requests: Any) -> grpc.StatusCode:
                stream = begin(channel, Call(method, b""))
                for request in requests:
                    await stream.write(request.SerializeToString())
                await stream.done_writing()
                return await status(stream)

            assert await ends(V1 + "GetTopic", nothing) is Status.NOT_FOUND
            assert await ends(V1 + "Subscribe", nothing) is Status.NOT_FOUND
            values = ["", "x", "1e999", "[1, 2", "9" * 5000, "\0", "1,5", "NaN"]
            step = v1.TopicDescriptor(path="cell/inputs/0/in")
            puts = [v1.PubRequest(topic=step, data=v1.ROSMessage(value=text)) for text in values]
            puts.append(v1.PubRequest(topic=nothing, data=v1.ROSMessage(value="1")))
            assert await ends(V1 + "Publish", *puts) is Status.OK
            assert await ends(V2 + "GetTopicInfo", v2.TopicInfoRequest(path=wrong)) is Status.OK
            assert await ends(V2 + "Subscribe", v2.SubscriptionRequest(path=wrong, subscriberUUID="polite")) is (
                Status.NOT_FOUND
            )
            assert await ends(V2 + "Read", v2.ReadRequest(path=[wrong])) is Status.NOT_FOUND
            for name in ("Write", "PublishSynch"):
                assert await ends(V2 + name, v2.PubRequest(topic=wrong)) is Status.NOT_FOUND
                assert await ends(V2 + name, v2.PubRequest(topic="cell/step/in")) is Status.INVALID_ARGUMENT
            assert await ends(V2 + "Publish", v2.PubRequest(topic=wrong), v2.PubRequest(topic="cell/step")) is Status.OK
            number = ours.Value(integer=1)
            for path, value, code in (
                (wrong, number, Status.NOT_FOUND),
                ("cell/step", ours.Value(text="x"), Status.INVALID_ARGUMENT),
                ("cell/step", ours.Value(), Status.INVALID_ARGUMENT),
            ):
                put = ours.WriteRequest(values=[ours.Assignment(path=path, value=value)])
                assert await ends(OURS + "Write", put) is code
            assert await ends(OURS + "Subscribe", ours.SubscribeRequest(patterns=[wrong])) is Status.NOT_FOUND
            lay = ours.InjectRequest(lay=ours.Lay(patterns=["cell/step"]))
            assert await ends(OURS + "Inject", ours.InjectRequest(lay=ours.Lay(patterns=[wrong]))) is Status.NOT_FOUND
            bad = ours.Shadow(assignments=[ours.Assignment(path=wrong, value=number)])
            assert await ends(OURS + "Inject", lay, ours.InjectRequest(shadow=bad)) is Status.NOT_FOUND
            unknown = ours.Declaration(name="x", targets=[wrong], drop=ours.Drop())
            declare = ours.DeclareRequest(declarations=[unknown])
            assert await ends(OURS + "Declare", declare) is Status.INVALID_ARGUMENT
            assert await ends(OURS + "Lift", ours.LiftRequest(source="nobody", number=1)) is Status.NOT_FOUND
            assert await ends(OURS + "LiftAll", ours.LiftAllRequest(sources=["nobody"])) is Status.NOT_FOUND
        assert served.service.counters[2:] == (0, len(puts) + 6)

    beside_a_polite_client(segment, test)
