"""The uplink with a real NATS server: what a bare client receives, also after an outage."""

from __future__ import annotations

import asyncio

import pytest

from shmio.errors import ConfigError
from shmio.fabric.connection import Access, connect
from shmio.fabric.registry import Registry
from shmio.segment import Frame, ProcessSpec, Quality, Segment
from tests.nats_server import NatsServer, link
from tests.unit.endpoints.fabric.harness import (
    CELL,
    LAYOUT,
    Listener,
    in_loop,
    listening,
    new_uplink,
    publish,
    until,
    uplink,
)


@in_loop
async def test_each_frame_is_published(segment: Segment, server: NatsServer) -> None:
    writer = segment.writer("cell")
    publish(writer, 1)
    async with listening(server.url) as listener, uplink(segment, server.url) as found:
        await until(lambda: found.publisher.up)
        for count in range(2, 50):
            publish(writer, count)
        writer.publish(bytes(8), cycle=50, quality=Quality.BAD, reason="no cable")
        publish(writer, 51)
        got = await listener.until(51)
    assert [count for one in got for count in one.counts] == [*range(2, 50), 0, 51]
    assert [one.header.number for one in got] == list(range(1, len(got) + 1))
    assert len({one.header.stream for one in got}) == 1
    assert {one.header.layout for one in got} == {LAYOUT.hash[:8]}
    assert {one.header.age_ns for one in got} == {0}
    assert {one.kind for one in got} == {"live"}
    frames = [entry for one in got for entry in one.entries if isinstance(entry, Frame)]
    (bad,) = [frame for frame in frames if frame.quality is Quality.BAD]
    assert bad.reason == "no cable"


@in_loop
async def test_the_registry_knows_the_cell(segment: Segment, server: NatsServer) -> None:
    publish(segment.writer("cell"), 1)
    async with uplink(segment, server.url) as found:
        await until(lambda: found.publisher.up)
        client = await connect(Access((server.url,)), "test")
        registry = await Registry.open(client)
        seen = await registry.find(CELL)
        assert seen is not None
        assert seen.alive
        assert [source.name for source in seen.entry.sources] == ["cell"], "a mirror is not offered again"
        (source,) = seen.entry.sources
        assert (source.quality, source.registers) == ("good", 2)
        assert await registry.layout(source.layout) == LAYOUT
        await found._renew(registry)
    seen = await registry.find(CELL)
    assert seen is not None
    assert seen.entry.state == "stopped"
    await client.close()


@in_loop
async def test_a_second_cell_of_the_name_is_refused(segment: Segment, server: NatsServer, instance: str) -> None:
    async with uplink(segment, server.url) as found:
        await until(lambda: found.publisher.up)
        with Segment.private("other", [], [ProcessSpec("fabric", "fabric")]) as other:
            second = new_uplink(other, server.url)
            await second.start()
            with pytest.raises(ConfigError, match=rf"instance {instance} on host \S+, .* instance other on host"):
                await asyncio.wait_for(second.run(), 20)
            await second.close()


async def _outage(segment: Segment, url: str, listener: Listener, cut: object, heal: object) -> None:
    """Publish frames before, during and after an outage, and check what the listener receives."""
    writer = segment.writer("cell")
    async with uplink(segment, url) as found:
        await until(lambda: found.publisher.up)
        for count in range(1, 11):
            publish(writer, count)
        got = await listener.until(10)
        await asyncio.to_thread(cut)  # type: ignore[arg-type]
        for count in range(11, 101):
            publish(writer, count)
            await asyncio.sleep(0)
        await until(lambda: not found.publisher.up)
        await asyncio.to_thread(heal)  # type: ignore[arg-type]
        await until(lambda: found.publisher.up and not found.backlog.waiting)
        publish(writer, 101)
        got += await listener.until(101)
        while len({one.header.number for one in got}) < got[-1].header.number:
            got.append(await listener.next())
    after = [one for one in got if one.counts[-1] > 10]
    assert (after[0].kind, after[0].counts[-1]) == ("live", 100), "the newest comes first"
    late = [one for one in after if one.kind == "late"]
    assert late, "an outage delays messages"
    numbers = [one.header.number for one in late]
    assert numbers == sorted(set(numbers)), "late messages come in order, each once"
    assert all(one.header.age_ns > 0 for one in late)
    counts = sorted({count for one in got for count in one.counts})
    assert counts == list(range(1, 102)), "nothing is lost"


@in_loop
async def test_a_restarted_server_gets_the_newest_first_then_the_rest(segment: Segment, server: NatsServer) -> None:
    async with listening(server.url) as listener:

        def heal() -> None:
            server.start()

        await _outage(segment, server.url, listener, server.stop, heal)


@in_loop
async def test_a_dead_link_is_noticed_and_nothing_is_lost(segment: Segment, server: NatsServer) -> None:
    with link(server) as proxy:
        async with listening(server.url) as listener:
            await _outage(segment, proxy.url, listener, proxy.cut, proxy.heal)
