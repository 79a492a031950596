"""An uplink that runs in the test's process, and a bare NATS client that receives its messages."""

from __future__ import annotations

import asyncio
import functools
import struct
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import nats
from nats.aio.client import Client
from nats.aio.msg import Msg

from shmio.endpoints.fabric.uplink import Uplink, UplinkSettings
from shmio.fabric.connection import Access
from shmio.fabric.messages import Entry, Header, decode_entries, decode_header
from shmio.fabric.tasks import end
from shmio.layout.model import Layout, Register
from shmio.segment import BlockWriter, Frame, Segment

LAYOUT = Layout(
    "DB1",
    1,
    8,
    False,
    (Register("count", "DINT", (), 0, None, 4, 1), Register("other", "DINT", (), 4, None, 4, 1)),
)
CELL = "plant1.line3.a50"
TIMEOUT_S = 60


Test = Callable[..., Coroutine[None, None, None]]


def in_loop(test: Test) -> Callable[..., None]:
    """Run a test in an event loop."""

    @functools.wraps(test)
    def run(*arguments: object, **fixtures: object) -> None:
        asyncio.run(test(*arguments, **fixtures))

    return run


class Got(NamedTuple):
    """A message of the uplink."""

    kind: str
    header: Header
    entries: list[Entry]

    @property
    def counts(self) -> list[int]:
        """The values of the register ``count``."""
        return [struct.unpack_from(">i", one.raw)[0] for one in self.entries if isinstance(one, Frame)]


def decoded(message: Msg) -> Got:
    """Decode a message."""
    data = bytes(message.data)
    return Got(message.subject.rpartition(".")[2], decode_header(data), list(decode_entries(data)))


class Listener:
    """A bare NATS client that has subscribed to a cell."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.queue: asyncio.Queue[Msg] = asyncio.Queue()

    async def next(self) -> Got:
        """Return the next message of a source."""
        return decoded(await asyncio.wait_for(self.queue.get(), TIMEOUT_S))

    async def until(self, count: int) -> list[Got]:
        """Return the messages until the one with this value of the register ``count``."""
        found = [await self.next()]
        while count not in found[-1].counts:
            found.append(await self.next())
        return found


@asynccontextmanager
async def listening(url: str, source: str = "cell") -> AsyncIterator[Listener]:
    """Receive all messages of a source."""
    client = await nats.connect(url, max_reconnect_attempts=-1, reconnect_time_wait=0.05)
    listener = Listener(client)
    for kind in ("live", "late"):
        await client.subscribe(f"shmio.{CELL}.{source}.{kind}", cb=listener.queue.put)
    await client.flush()
    try:
        yield listener
    finally:
        await client.close()


def new_uplink(segment: Segment, url: str, *, credentials: str | None = None, **settings: Any) -> Uplink:
    """Return an uplink that has not started."""
    options: dict[str, Any] = {"cell": CELL, "backlog_mb": 4.0, **settings}
    return Uplink(
        segment, segment.processes.find("fabric"), UplinkSettings(Access((url,), credentials=credentials), **options)
    )


@asynccontextmanager
async def uplink(segment: Segment, url: str, **settings: Any) -> AsyncIterator[Uplink]:
    """Run an uplink."""
    found = new_uplink(segment, url, **settings)
    await found.start()
    task = asyncio.create_task(found.run())
    try:
        yield found
    finally:
        await end(task)
        await found.close()
        if not task.cancelled() and (error := task.exception()) is not None:
            raise error


async def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition is true."""
    async with asyncio.timeout(TIMEOUT_S):
        while not condition():  # noqa: ASYNC110  another thread or a callback changes it
            await asyncio.sleep(0.005)


def publish(writer: BlockWriter, count: int, other: int = 0) -> None:
    """Publish a frame."""
    writer.publish(struct.pack(">ii", count, other), cycle=count)
