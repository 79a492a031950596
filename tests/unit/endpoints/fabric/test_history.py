"""The history: what a real NATS server with JetStream has stored, also after outages."""

from __future__ import annotations

import asyncio
import signal
from contextlib import suppress
from pathlib import Path

import nats
import pytest
from nats.js.api import ConsumerConfig, DeliverPolicy
from nats.js.errors import NotFoundError

from shmio.config.model import FabricHistory
from shmio.endpoints.fabric import history
from shmio.fabric.connection import Access
from shmio.fabric.history import fetch
from shmio.fabric.names import CellName
from shmio.fabric.place import Place
from shmio.segment import Segment
from tests.nats_server import NatsServer
from tests.unit.endpoints.fabric.harness import CELL, TIMEOUT_S, Got, decoded, in_loop, publish, until, uplink
from tests.unit.recorder.harness import numbers

STREAM = "shmio~plant1~line3~a50"
KEEP = FabricHistory(keep_days=2.0, keep_mb=5.0)


async def _stored(url: str) -> list[Got]:
    """Return all messages of the stream."""
    client = await nats.connect(url)
    try:
        stream = client.jetstream()
        count = (await stream.stream_info(STREAM)).state.messages
        ordered = await stream.subscribe(
            "shmio.>", stream=STREAM, ordered_consumer=True, config=ConsumerConfig(deliver_policy=DeliverPolicy.ALL)
        )
        return [decoded(await ordered.next_msg(20)) for _ in range(count)]
    finally:
        await client.close()


@in_loop
async def test_the_server_keeps_what_was_published(segment: Segment, server: NatsServer, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    async with uplink(segment, server.url, history=KEEP) as found:
        await until(lambda: found.publisher.up)
        for count in range(1, 31):
            publish(writer, count)
        await until(lambda: found._feeds["cell"].last == 30)
    got = await _stored(server.url)
    assert [count for one in got for count in one.counts] == list(range(1, 31))
    recording = tmp_path / "history.mem"
    place = Place(Access((server.url,)), CellName.parse(CELL))
    assert await asyncio.to_thread(fetch, place, recording) == 30
    assert numbers(recording) == list(range(1, 31))
    client = await nats.connect(server.url)
    info = await client.jetstream().stream_info(STREAM)
    assert (info.config.max_age, info.config.max_bytes) == (2 * 86_400, 5_000_000)
    await client.close()
    async with uplink(segment, server.url, history=FabricHistory(keep_mb=6.0)) as found:
        await until(lambda: found.publisher.up)
        assert not found.problem
    client = await nats.connect(server.url)
    assert (await client.jetstream().stream_info(STREAM)).config.max_bytes == 6_000_000, "new limits apply"
    await client.close()


@in_loop
async def test_a_killed_server_loses_nothing(segment: Segment, server: NatsServer) -> None:
    writer = segment.writer("cell")
    async with uplink(segment, server.url, history=KEEP) as found:
        await until(lambda: found.publisher.up)
        for count in range(1, 401):
            publish(writer, count)
            if count in (100, 200, 300):
                await asyncio.to_thread(server.stop, signal.SIGKILL)
                await until(lambda: not found.publisher.up)
            if count in (150, 250, 350):
                await asyncio.to_thread(server.start)
                await until(lambda: found.publisher.up)
            await asyncio.sleep(0)
        await until(lambda: found._feeds["cell"].last == 400 and not found.backlog.waiting)
    got = await _stored(server.url)
    numbers = [one.header.number for one in got]
    assert sorted(numbers) == list(range(1, max(numbers) + 1)), "each message is stored once"
    assert sorted(count for one in got for count in one.counts) == list(range(1, 401))


@in_loop
async def test_messages_wait_until_the_server_stores_them(
    segment: Segment, server: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.endpoints.fabric.uplink.RENEW_S", 0.05)
    monkeypatch.setattr(history, "ACK_NS", 100_000_000)
    writer = segment.writer("cell")
    async with uplink(segment, server.url, history=KEEP) as found:
        await until(lambda: found.publisher.up)
        publish(writer, 1)
        await until(lambda: found.backlog.rows["cell"].last == 1)
        client = await nats.connect(server.url)
        await client.jetstream().delete_stream(STREAM)
        for count in range(2, 12):
            publish(writer, count)
        await until(lambda: found._feeds["cell"].last == 11)
        assert found.publisher.up, "live messages go on"
        counts: set[int] = set()
        async with asyncio.timeout(TIMEOUT_S):
            while not counts >= set(range(2, 12)):
                with suppress(NotFoundError):
                    counts = {count for one in await _stored(server.url) for count in one.counts}
        await until(lambda: not found.problem and not found.backlog.waiting and not found._history.waiting)  # type: ignore[union-attr]
        await client.close()


@in_loop
async def test_a_server_without_room_is_reported(segment: Segment, server: NatsServer) -> None:
    async with uplink(segment, server.url, history=FabricHistory(replicas=3)) as found:
        await until(lambda: found.publisher.up)
        await until(lambda: "fabric.history" in found.problem)
        assert "replicas" in found.problem
        client = await nats.connect(server.url)
        with pytest.raises(NotFoundError):
            await client.jetstream().stream_info(STREAM)
        await client.close()
