"""A cell whose messages a test stores in the history of a NATS server, beside a recording of the same frames."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import nats
from nats.aio.client import Client
from nats.js.errors import NotFoundError

from shmio.fabric.connection import Access
from shmio.fabric.messages import Header, encode
from shmio.fabric.names import CellName
from shmio.fabric.place import Place
from shmio.fabric.registry import Registry
from shmio.layout.model import Layout
from shmio.recorder.instance_follower import InstanceFollower
from shmio.recording.block_follower import BlockEntry
from shmio.segment import Segment
from tests.unit.recorder.harness import LAYOUT, recorder

CELL = CellName("plant1", "line3", "a50")


class Stored(NamedTuple):
    """A message that the test has published, and its header."""

    subject: str
    header: Header
    data: bytes


class History:
    """Publishes messages to the stream of a cell."""

    def __init__(self, url: str, cell: CellName = CELL) -> None:
        self.cell = cell
        self.url = url
        self._url = url

    @property
    def place(self) -> Place:
        return Place(Access((self._url,)), self.cell)

    def create(self, *layouts: Layout) -> None:
        """Create the stream and the registry with some layouts."""

        async def work(client: Client) -> None:
            await client.jetstream().add_stream(
                name=self.cell.history, subjects=[self.cell.live("*"), self.cell.late("*")]
            )
            registry = await Registry.open(client)
            for layout in layouts or (LAYOUT,):
                await registry.put_layout(layout)

        self.run(work)

    def publish(self, *messages: Stored) -> None:
        """Publish messages; each is stored when this returns."""

        async def work(client: Client) -> None:
            stream = client.jetstream()
            for first in range(0, len(messages), 200):
                await asyncio.gather(*(stream.publish(one.subject, one.data) for one in messages[first : first + 200]))

        self.run(work)

    def last(self) -> int:
        """Return the number of the last message in the stream."""

        async def work(client: Client) -> int:
            return (await client.jetstream().stream_info(self.cell.history)).state.last_seq

        return int(self.run(work))

    def delivered(self, folder: Path) -> int:
        """Return the number of the last message that the archive in a folder has received."""
        file = folder / ".archive"

        async def work(client: Client) -> int:
            name = f"archive-{file.read_text()}"
            with suppress(NotFoundError):
                info = await client.jetstream().consumer_info(self.cell.history, name)
                return info.delivered.stream_seq if info.delivered is not None else 0
            return 0

        return int(self.run(work)) if file.exists() and file.read_text() else 0

    def forget(self, folder: Path) -> None:
        """Delete what the server knows of the archive in a folder."""
        file = folder / ".archive"

        async def work(client: Client) -> None:
            with suppress(NotFoundError):
                await client.jetstream().delete_consumer(self.cell.history, f"archive-{file.read_text()}")

        if file.exists():
            self.run(work)

    def run(self, work: Any) -> Any:
        async def connected() -> Any:
            client = await nats.connect(self._url)
            try:
                return await work(client)
            finally:
                await client.close()

        coroutine: Coroutine[Any, Any, Any] = connected()
        return asyncio.run(coroutine)


class Uplink:
    """Makes messages of what the sources publish, as the uplink does: one message for each call and source."""

    def __init__(self, segment: Segment, cell: CellName = CELL, stream: int = 1) -> None:
        self._segment, self._cell, self.stream = segment, cell, stream
        self._follower = InstanceFollower(segment)
        self._numbers: dict[str, int] = {}

    def messages(self, *, each: int = 1) -> list[Stored]:
        """Return messages of all new entries, with at most ``each`` entries."""
        made: list[Stored] = []
        entries = [entry for entry in self._follower.take()[0] if isinstance(entry, BlockEntry)]
        for follower in {entry.follower: 0 for entry in entries}:
            own = [entry.item for entry in entries if entry.follower is follower]
            made += [self.message(follower.block.source, follower.block.layout, own[at : at + each])
                     for at in range(0, len(own), each)]  # fmt: skip
        return made

    def message(self, source: str, layout: Layout, items: list[Any], left_out: int = 0) -> Stored:
        head = self._segment.header
        number = self._numbers[source] = self._numbers.get(source, 0) + 1
        zero_ns = head.started_utc_ns - head.started_ns
        made_ns = zero_ns + time.monotonic_ns()
        header = Header(left_out, self.stream, number, layout.hash[:8], made_ns, 0, zero_ns)
        return Stored(self._cell.live(source), header, bytes(encode(header, items)))


def late(message: Stored) -> Stored:
    """Return a message as it is published after an outage."""
    return message._replace(subject=message.subject.removesuffix("live") + "late")


@contextmanager
def recorded(segment: Segment, folder: Path) -> Iterator[Any]:
    """Record a segment while the block runs; yield the recorder."""
    work = recorder(segment, folder)
    yield work
    work.run_once()
    assert work.close()
