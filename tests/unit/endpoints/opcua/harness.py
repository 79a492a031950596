"""An OPC UA endpoint over a real socket: the test publishes into a segment, and clients receive."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import cached_property
from types import SimpleNamespace
from typing import Any

from asyncua import Client, ua

from shmio.config import OpcUa
from shmio.endpoints.opcua.endpoint import Endpoint
from shmio.segment import Attributes, BlockSpec, BlockWriter, ProcessSpec, Quality, Segment
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, WRITABLE

WRITER = 6
TIMEOUT_S = 30
ABOUT = ("Quality", "Reason", "Lift", "LiftAll", "Injections")
"""Names of the properties and methods that each source has."""


def spec(source: str = "cell", layout: Any = LAYOUT, stale_ns: int = STALE_NS) -> BlockSpec:
    return BlockSpec(source, layout, 20_000_000, stale_ns, 1 << 20, Attributes("test", WRITABLE))


def processes() -> list[ProcessSpec]:
    return [ProcessSpec("cell", "source"), ProcessSpec("opcua", "opcua")]


class Served:
    """An endpoint that serves a segment."""

    def __init__(self, segment: Segment, endpoint: Endpoint) -> None:
        self.segment, self.endpoint = segment, endpoint
        self.cycle = 0
        port = endpoint.server.port
        self.port = port
        self.url = f"opc.tcp://127.0.0.1:{port}/"

    @cached_property
    def writer(self) -> BlockWriter:
        return self.segment.writer("cell")

    def publish(self, raw: bytes, quality: Quality = Quality.GOOD, **more: Any) -> None:
        self.cycle += 1
        self.writer.publish(raw, cycle=self.cycle, quality=quality, **more)

    @asynccontextmanager
    async def client(self, **user: Any) -> AsyncIterator[Client]:
        client = Client(self.url, timeout=TIMEOUT_S)
        if user:
            client.set_user(user["name"])
            client.set_password(user["password"])
        async with client:
            yield client

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait until the endpoint's loop or a thread has made a condition true."""
        async with asyncio.timeout(TIMEOUT_S):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0.001)


def node(client: Client, path: str) -> Any:
    return client.get_node(ua.NodeId(path, 2))


class Changes:
    """Receives the changes of a subscription, in order."""

    def __init__(self) -> None:
        self.come: asyncio.Queue[tuple[str, ua.DataValue]] = asyncio.Queue()
        self.seen: list[tuple[str, ua.DataValue]] = []

    def datachange_notification(self, node: Any, _value: Any, data: Any) -> None:
        self.come.put_nowait((str(node.nodeid.Identifier), data.monitored_item.Value))

    async def until(self, path: str, accept: Callable[[ua.DataValue], bool]) -> ua.DataValue:
        """Return the next change of a node for which ``accept`` is true."""
        while True:
            name, value = await asyncio.wait_for(self.come.get(), TIMEOUT_S)
            self.seen.append((name, value))
            if name == path and accept(value):
                return value


@asynccontextmanager
async def served(segment: Segment, **config: Any) -> AsyncIterator[Served]:
    config.setdefault("listen", "127.0.0.1:0")
    with Segment.open(segment.instance, writable=True) as opened:
        slot: Any = SimpleNamespace(writer=WRITER)
        endpoint = Endpoint(opened, slot, OpcUa(**config))
        await endpoint.start()
        try:
            yield Served(segment, endpoint)
        finally:
            await endpoint.stop()


def serve(segment: Segment, test: Callable[[Served], Awaitable[None]], **config: Any) -> None:
    async def run() -> None:
        async with served(segment, **config) as one:
            await test(one)

    asyncio.run(run())
