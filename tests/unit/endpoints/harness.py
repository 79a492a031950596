"""A gRPC endpoint over real sockets: the test publishes into a segment, and a client receives."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import cached_property
from typing import Any

import grpc
import pytest
from google.protobuf.struct_pb2 import Value
from grpc_health.v1 import health_pb2, health_pb2_grpc

from shmio.config import Address
from shmio.endpoints.grpc.server.access import Keys, Listener, ListenerAccess
from shmio.endpoints.grpc.server.call_guard import CallLimits, OpenCalls
from shmio.endpoints.grpc.server.server import Server
from shmio.endpoints.grpc.services.services import Services
from shmio.endpoints.grpc.streams.feed import Feed, VirtualTime
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.layout.model import Layout, Register
from shmio.segment import BlockWriter, Quality, Segment
from shmio.wire import simlog_v1_pb2 as wire
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub
from shmio.wire.simserver_pb2_grpc import SimServerAPIStub

WRITER = 4
LAYOUT = Layout(
    "DB1",
    1,
    628,
    False,
    (
        Register("axis/position", "REAL", (), 0, None, 4, 1),
        Register("axis/speed", "REAL", (), 4, None, 4, 1),
        Register("running", "BOOL", (), 8, 3, 1, 1),
        Register("inputs", "BYTE", ((0, 1),), 10, None, 2, 2),
        Register("step", "INT", (), 12, None, 2, 1),
        Register("bits", "BOOL", ((0, 9),), 14, 0, 2, 10),
        Register("name", "STRING[8]", (), 16, None, 10, 1),
        Register("long", "BYTE", ((1, 600),), 26, None, 600, 600),
        Register("secret", "INT", (), 626, None, 2, 1),
    ),
)
WRITABLE = ("axis", "running", "inputs", "step", "bits", "name", "long")
STALE_NS = 60_000_000_000
"""Age in ns after which frames are stale: so long that a busy host does not make a source stale."""
SOON_STALE_NS = 300_000_000
TIMEOUT_S = 60
"""Time-out of a test in s. No test needs so long if it succeeds."""
LOOK_S = 0.001


LOOPBACK = Listener(Address("127.0.0.1", 0), ListenerAccess(Keys()))
"""A listener that gives all rights to every program of this host."""


def image(
    position: float = 0.0, speed: float = 0.0, running: bool = False, inputs: bytes = b"\0\0", step: int = 0
) -> bytes:
    return struct.pack(">ffBx2sh", position, speed, running << 3, inputs, step).ljust(LAYOUT.size, b"\0")


class Endpoint:
    """A served segment, and a client of it."""

    def __init__(
        self, segment: Segment, wake_ups: WakeUps, feeds: dict[str, Feed], service: Services, server: Server, port: int
    ) -> None:
        self.segment = segment
        self.wake_ups = wake_ups
        self.feeds = feeds
        self.service = service
        self.server = server
        self.port = port
        self.channel = grpc.aio.insecure_channel(f"127.0.0.1:{port}")
        self.stub: Any = SimlogAPIStub(self.channel)  # type: ignore[no-untyped-call]
        self.v2: Any = SimlogV2Stub(self.channel)  # type: ignore[no-untyped-call]
        self.time: Any = SimServerAPIStub(self.channel)  # type: ignore[no-untyped-call]
        self.cycle = 0

    @cached_property
    def writer(self) -> BlockWriter:
        """Return the writer of the source ``cell``."""
        return self.segment.writer("cell")

    def publish(self, raw: bytes, quality: Quality = Quality.GOOD) -> None:
        self.cycle += 1
        self.writer.publish(raw, cycle=self.cycle, quality=quality)

    def subscribe(self, path: str) -> Any:
        return self.stub.Subscribe(wire.TopicDescriptor(path=path), timeout=TIMEOUT_S)

    async def subscriber(self, uuid: str, *paths: str) -> Any:
        """Open a version 2 stream that has subscribed to these paths."""
        stream = self.v2.CreateSubscriber(v2.Subscriber(name="test", uuid=uuid), timeout=TIMEOUT_S)
        await stream.initial_metadata()
        for path in paths:
            await self.add(uuid, path)
        return stream

    async def add(self, uuid: str, path: str) -> None:
        await self.v2.Subscribe(v2.SubscriptionRequest(path=path, subscriberUUID=uuid), timeout=TIMEOUT_S)

    async def health(self, service: str) -> int:
        stub: Any = health_pb2_grpc.HealthStub(self.channel)
        answer = await stub.Check(health_pb2.HealthCheckRequest(service=service), timeout=TIMEOUT_S)
        return int(answer.status)

    async def until(self, condition: Callable[[], Awaitable[bool]]) -> None:
        """Wait until another thread has made a condition true."""
        async with asyncio.timeout(TIMEOUT_S):
            while not await condition():  # noqa: ASYNC110  another thread changes it
                await asyncio.sleep(LOOK_S)  # gives the other thread the interpreter


@asynccontextmanager
async def endpoint(
    segment: Segment, limits: CallLimits | None = None, before: int = 0, port: int = 0
) -> AsyncIterator[Endpoint]:
    """Serve a segment.

    Args:
        before: Process id of the previous endpoint.
        port: Port of the previous endpoint, to reuse it.
    """
    tasks: set[asyncio.Task[None]] = set()

    def on_quality(source: str, good: bool) -> None:
        tasks.add(asyncio.get_running_loop().create_task(server.set_source(source, good)))

    virtual_time = VirtualTime()
    wake_ups = WakeUps()
    feeds = {name: Feed(block, WRITER, wake_ups, on_quality, virtual_time) for name, block in segment.blocks.items()}
    service = Services(segment, segment.processes.find("grpc"), virtual_time, wake_ups, feeds, next(iter(feeds)))
    server = Server(service.calls, OpenCalls(limits))
    for source in feeds:
        await server.set_source(source, False)
    ports = await server.start([LOOPBACK._replace(address=Address("127.0.0.1", port))])
    for feed in feeds.values():
        feed.start()
    await service.stepper.start(before)
    served = Endpoint(segment, wake_ups, feeds, service, server, ports[0])
    try:
        yield served
    finally:
        await served.channel.close()
        for feed in feeds.values():
            feed.stop()
        await service.stepper.stop()
        await server.stop()
        await asyncio.gather(*tasks)
        wake_ups.close()


def serve(segment: Segment, test: Callable[[Endpoint], Awaitable[None]], limits: CallLimits | None = None) -> None:
    async def run() -> None:
        async with endpoint(segment, limits) as served:
            await test(served)

    asyncio.run(run())


async def value(stream: Any) -> str:
    message = await asyncio.wait_for(stream.read(), TIMEOUT_S)
    return str(message.value)


async def message(stream: Any) -> tuple[str, Any]:
    """Return path and value of version 2's next message, as Python values."""
    got = await asyncio.wait_for(stream.read(), TIMEOUT_S)
    assert got is not grpc.aio.EOF
    return got.header.path, plain(got.value)


def plain(value: Value) -> Any:
    """Return a google.protobuf.Value as a Python value."""
    kind = value.WhichOneof("kind")
    if kind == "list_value":
        return [plain(item) for item in value.list_value.values]
    if kind == "struct_value":
        return {name: plain(item) for name, item in value.struct_value.fields.items()}
    assert kind is not None
    return None if kind == "null_value" else getattr(value, kind)


async def refusal(call: Any) -> tuple[grpc.StatusCode, str]:
    """Return the status and message with which a call ends."""
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        await call
    return caught.value.code(), str(caught.value.details())


async def code(call: Any) -> grpc.StatusCode:
    return (await refusal(call))[0]


async def listening(served: Endpoint, streams: int) -> bool:
    await asyncio.sleep(0)
    return served.service.counters[0] == streams
