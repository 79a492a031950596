"""A list of all calls that clients can make, and a check that misbehaving clients leave nothing behind."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import grpc
from google.protobuf.struct_pb2 import Value
from grpc_health.v1 import health_pb2
from grpc_reflection.v1alpha import reflection_pb2

from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as ours
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as simserver
from tests.unit.endpoints.grpc.services.test_publish import plant
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, endpoint, message, value
from tests.unit.endpoints.plant import Plant

V1, V2 = "/simulation.server.SimlogAPI/", "/simlog.server.SimlogAPI/"
SIM, OURS = "/com.ttsnetwork.simulator3.SimServerAPI/", "/shmio.v1.Shmio/"
HEALTH, REFLECTION = "/grpc.health.v1.Health/", "/grpc.reflection.v1alpha.ServerReflection/"


class Call(NamedTuple):
    """A call, and how it behaves.

    Attributes:
        many: Whether it takes a stream of messages.
        stays: Whether it stays open after its message until its client ends it.
        first: The first message, if the call requires one that differs from the others.
        ends: The status with which it succeeds.
    """

    method: str
    request: bytes
    many: bool = False
    stays: bool = False
    first: bool = False
    ends: grpc.StatusCode = grpc.StatusCode.OK


def _put(path: str) -> bytes:
    data = v2.SimlogMessage(type=v2.NUMBER, value=Value(number_value=5))
    return v2.PubRequest(topic=path, data=data).SerializeToString()


def _inject(target: str) -> v1.InjectRequest:
    shadow = v1.TopicDescriptor(path=f"{target}/shadow")
    return v1.InjectRequest(injected=shadow, target=v1.TopicDescriptor(path=target))


def _lay(path: str) -> bytes:
    return ours.InjectRequest(lay=ours.Lay(patterns=[path], name="rude")).SerializeToString()


NOISE = ours.Declaration(
    name="rude", targets=["cell/bits"], flip=ours.Flip(bits=[0]), when="cell/step mod 2 == 1"
)  # no other call injects there
SPEED = ours.Assignment(path="cell/axis/speed", value=ours.Value(number=5))

CALLS = (
    Call(V1 + "GetTopic", v1.TopicDescriptor(path="cell/inputs").SerializeToString()),
    Call(V1 + "Subscribe", v1.TopicDescriptor(path="cell/inputs").SerializeToString(), stays=True),
    Call(V1 + "Subscribe", v1.TopicDescriptor(path="cell/inputs/in").SerializeToString(), stays=True),
    Call(
        V1 + "Publish",
        v1.PubRequest(
            topic=v1.TopicDescriptor(path="cell/axis/speed/in"), data=v1.ROSMessage(type="double", value="1.0E-4")
        ).SerializeToString(),
        many=True,
        stays=True,
    ),
    Call(V1 + "Inject", _inject("cell/bits/in").SerializeToString(), stays=True),
    Call(V1 + "Inject", _inject("cell/bits/out").SerializeToString(), stays=True),
    Call(V2 + "GetTopicInfo", v2.TopicInfoRequest(path="CELL://inputs").SerializeToString()),
    Call(V2 + "CreateSubscriber", v2.Subscriber(name="rude", uuid="rude").SerializeToString(), stays=True),
    Call(
        V2 + "Subscribe", v2.SubscriptionRequest(path="CELL://inputs/out", subscriberUUID="polite").SerializeToString()
    ),
    Call(V2 + "Subscribe", v2.SubscriptionRequest(path="SIMLOG://step", subscriberUUID="polite").SerializeToString()),
    Call(V2 + "Read", v2.ReadRequest(path=["CELL://inputs", "cell/axis"]).SerializeToString()),
    Call(V2 + "Write", _put("CELL://axis/speed/in")),
    Call(V2 + "Inject", v2.InjectRequest(targetPath="CELL://name/in", shadowPathPrefix="rude").SerializeToString()),
    Call(V2 + "PublishSynch", _put("CELL://axis/speed/in")),
    Call(V2 + "Publish", _put("CELL://axis/speed/in"), many=True, stays=True),
    Call(V1 + "setStepSize", v1.StepSizeRequest(step=20).SerializeToString()),
    Call(V1 + "step", b""),
    Call(SIM + "subscribe", b"", stays=True),
    Call(SIM + "step", simserver.StepRequest(deltaTime=50).SerializeToString()),
    Call(SIM + "pause", b""),
    Call(OURS + "GetLayouts", b""),
    Call(OURS + "GetStatus", b""),
    Call(OURS + "Read", ours.ReadRequest(patterns=["cell/axis/*"]).SerializeToString()),
    Call(OURS + "Subscribe", ours.SubscribeRequest(patterns=["cell/inputs"]).SerializeToString(), stays=True),
    Call(OURS + "Subscribe", ours.SubscribeRequest(patterns=["cell/inputs/in"]).SerializeToString(), stays=True),
    Call(OURS + "Write", ours.WriteRequest(values=[SPEED]).SerializeToString()),
    Call(OURS + "Inject", _lay("cell/bits"), many=True, stays=True, first=True),
    Call(OURS + "Inject", _lay("cell/bits/in"), many=True, stays=True, first=True),
    Call(OURS + "Declare", ours.DeclareRequest(declarations=[NOISE]).SerializeToString(), stays=True),
    Call(OURS + "ListInjections", b""),
    Call(OURS + "Lift", ours.LiftRequest(source="cell", number=7).SerializeToString(), ends=grpc.StatusCode.NOT_FOUND),
    Call(OURS + "LiftAll", ours.LiftAllRequest(sources=["cell"]).SerializeToString()),
    Call(OURS + "Step", ours.StepRequest(dt_ns=50_000_000).SerializeToString()),
    Call(OURS + "Steps", ours.StepsRequest(dt_ns=50_000_000, count=2).SerializeToString(), many=True, stays=True),
    Call(OURS + "SetStepSize", ours.SetStepSizeRequest(dt_ns=50_000_000).SerializeToString()),
    Call(OURS + "Pause", b""),
    Call(OURS + "WatchClock", b"", stays=True),
    Call(OURS + "Replay", b"", ends=grpc.StatusCode.FAILED_PRECONDITION),
    Call(HEALTH + "Check", health_pb2.HealthCheckRequest(service="source.cell").SerializeToString()),
    Call(HEALTH + "Watch", health_pb2.HealthCheckRequest(service="source.cell").SerializeToString(), stays=True),
    Call(
        REFLECTION + "ServerReflectionInfo",
        reflection_pb2.ServerReflectionRequest(list_services="*").SerializeToString(),
        many=True,
        stays=True,
    ),
)
"""All calls that the endpoint serves; a subscriber ``polite`` must exist."""


class Polite:
    """A client of both versions that reads its streams while other clients misbehave."""

    def __init__(self, served: Endpoint, device: Plant, first: Any, second: Any) -> None:
        self._served = served
        self.device = device
        self._streams = first, second
        self._values = itertools.count(1)

    async def goes_on(self) -> None:
        """Wait until a new value arrives on both streams, as the next message of each."""
        number = next(self._values) % 30_000
        self.device.memory[12:14] = number.to_bytes(2, "big")
        first, second = self._streams
        assert await value(first) == str(number)
        path, got = await message(second)
        while path != "cell/step":  # another call may have subscribed it to another topic
            path, got = await message(second)
        assert got == number

    async def alone(self, *, connected: bool = False) -> None:
        """Wait until nothing is left of other clients.

        That is, none of their calls, streams, topics, commands, bytes and injections exists.

        ``connected``: the other client is still connected, so its injection of version 2 may remain.
        """
        served, feed = self._served, self._served.feeds["cell"]

        async def left() -> bool:
            await asyncio.sleep(0)
            topics = {subject.path for subject in feed._channels} - {"inputs"}
            return (len(served.server.calls), served.service.counters[0], topics) == (2, 2, {"step"}) and not (
                feed.commands.write_subscriptions.busy
                or feed.commands.followers.busy
                or feed.commands._in_flight
                or served.service.waiting_bytes
                or any(not (connected and one.name.startswith("SIMLOG")) for one in feed.block.injections.read())
            )

        await served.until(left)
        await self.goes_on()


@asynccontextmanager
async def polite(served: Endpoint, device: Plant) -> AsyncIterator[Polite]:
    """Run a well-behaved client, and yield when it has received its first values."""
    await served.until(_good(served))
    first, second = served.subscribe("cell/step"), await served.subscriber("polite", "cell/step")
    assert await value(first) == "0"
    assert await message(second) == ("cell/step", 0)
    try:
        yield Polite(served, device, first, second)
    finally:
        first.cancel()
        second.cancel()


def beside_a_polite_client(segment: Segment, test: Callable[[Endpoint, Polite], Awaitable[None]]) -> None:
    """Run a test with a device and a well-behaved client; check that nothing is left of others."""

    async def run() -> None:
        async with endpoint(segment) as served, plant(served) as device, polite(served, device) as beside:
            await test(served, beside)
            await beside.alone()

    asyncio.run(run())


def connect(served: Endpoint) -> grpc.aio.Channel:
    """Open a new connection."""
    return grpc.aio.insecure_channel(f"127.0.0.1:{served.port}", [("grpc.use_local_subchannel_pool", 1)])


def begin(channel: grpc.aio.Channel, call: Call, timeout_s: float = TIMEOUT_S) -> Any:
    """Open a call of raw bytes without sending a message."""
    return channel.stream_stream(call.method)(timeout=timeout_s)


async def status(stream: Any) -> grpc.StatusCode:
    """Drain a stream and return its status."""
    async with asyncio.timeout(TIMEOUT_S):
        try:
            while await stream.read() is not grpc.aio.EOF:
                pass
        except grpc.aio.AioRpcError as error:
            return error.code()
        except asyncio.CancelledError:
            if not stream.cancelled():
                raise
        code: grpc.StatusCode = await stream.code()
        return code


def _good(served: Endpoint) -> Callable[[], Awaitable[bool]]:
    async def good() -> bool:
        await asyncio.sleep(0)
        return served.segment.blocks["cell"].latest() is not None

    return good
