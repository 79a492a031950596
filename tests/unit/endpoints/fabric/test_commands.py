"""Commands of other cells: the outcomes that a bare NATS client gets, and the audit log's entries."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import nats
import pytest

from shmio.audit import trail
from shmio.audit.file import AuditSettings
from shmio.config.model import FabricAllow, FabricRule
from shmio.endpoints.fabric import commands as module
from shmio.endpoints.fabric.uplink import Uplink
from shmio.fabric.messages import CommandReply, CommandRequest, WriteItem, decode_reply, encode_command
from shmio.layout.model import Layout
from shmio.layout.values.write import Write, paths_of
from shmio.segment import Segment
from tests.nats_server import NatsServer
from tests.unit.endpoints.fabric.harness import CELL, LAYOUT, TIMEOUT_S, in_loop, until, uplink
from tests.unit.endpoints.plant import Plant

ALLOW = [FabricAllow(sender=["plant1.*.*"], roles=["write"]), FabricAllow(sender="*.*.*", roles=["read"])]
FRIEND = "plant1.line1.twin"
HOUR_NS = 3_600_000_000_000


@pytest.fixture
def plant(segment: Segment) -> Iterator[Plant]:
    plant = Plant(segment.writer("cell"))
    plant.cycle()
    plant.run()
    yield plant
    plant.stop()


class Commander:
    """A bare NATS client that sends commands to an uplink."""

    def __init__(self, client: Any, found: Uplink) -> None:
        self.client, self.uplink = client, found

    @property
    def stream(self) -> int:
        return self.uplink.backlog.rows["cell"].stream

    async def send(
        self, data: bytes, sender: str = FRIEND, source: str = "cell", timeout_s: float = TIMEOUT_S
    ) -> bytes:
        """Send bytes to the subject of commands, and return the reply."""
        subject = f"shmio.{CELL}.{source}.command.{sender}"
        return bytes((await self.client.request(subject, data, timeout=timeout_s)).data)

    async def write(
        self, *writes: tuple[int, int, bytes], sender: str = FRIEND, source: str = "cell", expires_ns: int = HOUR_NS,
        layout: bytes = b"", stream: int = 0,
    ) -> CommandReply:  # fmt: skip
        """Write, and return the outcomes."""
        now_ns = self.uplink._log_time(time.monotonic_ns())
        digest = layout or self.uplink._feeds["cell"].digest[:8]
        request = CommandRequest(
            now_ns + expires_ns, stream or self.stream, digest, [WriteItem(*write) for write in writes]
        )
        return decode_reply(await self.send(encode_command(request), sender, source), len(writes))


@asynccontextmanager
async def commander(segment: Segment, url: str, **settings: Any) -> AsyncIterator[Commander]:
    """Run an uplink and a client that sends commands."""
    async with uplink(segment, url, **{"allow": ALLOW, **settings}) as found:
        client = await nats.connect(url)
        await until(lambda: found.publisher.up)
        try:
            yield Commander(client, found)
        finally:
            await client.close()


@in_loop
async def test_writes_reach_the_device(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with commander(segment, server.url) as client:
        reply = await client.write((0, 0, b"\0\0\0\x07"))
        assert reply == CommandReply(["written"], [""])
        assert plant.memory[:4] == b"\0\0\0\x07"
        reply = await client.write((0, 0, b"\1"), (3, 0x80, b"\xff"), (1, 0, b"\2"))
        assert reply.outcomes == ["written"] * 3
        assert plant.memory[:4] == b"\1\2\0\x87"
        plant.refusal = "the key switch is in position AUTO"
        assert await client.write((0, 0, b"\1")) == CommandReply(["refused"], [plant.refusal])


@in_loop
async def test_the_source_checks_each_command(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with commander(segment, server.url) as client:
        for writes in ([(4, 0, b"\1")], [(0, 0, b"\1"), (4, 0, b"\1")], [(7, 0, b"\1\2")], [(1 << 40, 0, b"\1")]):
            reply = await client.write(*writes)
            assert reply.outcomes == ["rejected"] * len(writes), writes
            assert all(reply.reasons)
        reply = await client.write((4, 0, b"\1\2\3\4"))
        for word in (CELL, socket.gethostname(), "cell/other is not writable", "`writable`", "supervisor.toml"):
            assert word in reply.reasons[0]
        assert plant.memory == bytes(8)


@in_loop
async def test_only_allowed_cells_write(segment: Segment, server: NatsServer, plant: Plant, tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    trail.open_trail(AuditSettings(str(file), 1 << 20, 2), segment.instance, "fabric")
    try:
        async with commander(segment, server.url) as client:
            reply = await client.write((0, 0, b"\1"), sender="plant2.line1.twin")
            assert reply.outcomes == ["rejected"]
            assert "fabric.allow" in reply.reasons[0]
            assert (await client.write((3, 0, b"\5"))).outcomes == ["written"]
            assert client.uplink.commands.refused == 1
    finally:
        trail.close_trail()
    entries = [json.loads(line) for line in file.read_text().splitlines()]
    assert [(one["kind"], one["who"], one["endpoint"], one["outcome"]) for one in entries] == [
        ("cell", "plant2.line1.twin", "fabric", "denied"),
        ("cell", FRIEND, "fabric", "written"),
    ]
    assert entries[0]["what"] == {"source": "cell", "paths": ["cell/count.%B3"]}
    assert entries[0]["reason"].endswith("in this cell's supervisor.toml, and reload it")
    assert list(entries[1]["what"]) == ["cell/count.%B0"]


@in_loop
async def test_the_audit_says_which_registers_of_this_cell_are_not_writable(
    segment: Segment, server: NatsServer, plant: Plant, tmp_path: Path
) -> None:
    file = tmp_path / "audit.jsonl"
    trail.open_trail(AuditSettings(str(file), 1 << 20, 2), segment.instance, "fabric")
    try:
        async with commander(segment, server.url) as client:
            reply = await client.write((4, 0, b"\1\2\3\4"))
            assert "name it in the source's `writable` in that cell's supervisor.toml" in reply.reasons[0]
    finally:
        trail.close_trail()
    (entry,) = map(json.loads, file.read_text().splitlines())
    assert entry["what"].keys() == {"cell/other"}
    assert entry["reason"].endswith("name it in the source's `writable` in this cell's supervisor.toml, and reload it")


@in_loop
async def test_a_denied_cell_cannot_fill_the_audit_log_with_registers(
    segment: Segment, server: NatsServer, tmp_path: Path
) -> None:
    file = tmp_path / "audit.jsonl"
    trail.open_trail(AuditSettings(str(file), 1 << 20, 2), segment.instance, "fabric")
    try:
        async with commander(segment, server.url) as client:
            for number in range(50):
                await client.write((number % 8, 0, b"\1"), sender="plant2.line1.twin")
            for wrong in ((1 << 40, 0, b"\1"), (0, 0, bytes(1 << 16))):
                await client.write(wrong, sender="plant2.line1.twin")
    finally:
        trail.close_trail()
    entries = [json.loads(line) for line in file.read_text().splitlines()]
    assert sum(one["count"] for one in entries) == 52
    assert len(entries) < 25


@in_loop
async def test_a_denied_command_of_many_items_costs_little(
    segment: Segment, server: NatsServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    described: list[int] = []

    def counted(layout: Layout, writes: Sequence[Write], most: int | None = None) -> list[str]:
        described.append(len(writes))
        return paths_of(layout, writes, most)

    monkeypatch.setattr(module, "paths_of", counted)
    file = tmp_path / "audit.jsonl"
    trail.open_trail(AuditSettings(str(file), 1 << 20, 2), segment.instance, "fabric")
    try:
        async with commander(segment, server.url) as client:
            await client.write(*[(0, 0, b"\1")] * 4096, sender="plant2.line1.twin")
    finally:
        trail.close_trail()
    assert described == [trail.MAX_NAMED]
    assert json.loads(file.read_text())["what"]["paths"] == ["cell/count.%B3"]


@in_loop
async def test_a_command_cannot_send_its_outcome_into_the_fabric(
    segment: Segment, server: NatsServer, plant: Plant
) -> None:
    async with commander(segment, server.url) as client:
        request = CommandRequest(1 << 62, client.stream, LAYOUT.hash[:8], [WriteItem(0, 0, b"\1")])
        subject = f"shmio.{CELL}.cell.command.{FRIEND}"
        await client.client.publish(subject, encode_command(request), reply=f"shmio.{CELL}.cell.live")
        await until(lambda: client.uplink.commands.refused == 1)
        assert plant.memory == bytes(8)


@in_loop
async def test_a_command_that_comes_late_expires(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with commander(segment, server.url) as client:
        assert (await client.write((0, 0, b"\1"), expires_ns=-1)).outcomes == ["expired"]
        assert plant.memory == bytes(8)


@in_loop
async def test_a_command_for_an_earlier_uplink_expires(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with commander(segment, server.url) as client:
        reply = await client.write((0, 0, b"\1"), stream=client.stream - 1)
        assert (reply.outcomes, "restarted" in reply.reasons[0]) == (["expired"], True)
        assert plant.memory == bytes(8)


@in_loop
async def test_a_command_for_another_layout_is_rejected(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with commander(segment, server.url) as client:
        reply = await client.write((0, 0, b"\1"), layout=b"12345678")
        assert (reply.outcomes, "layout" in reply.reasons[0]) == (["rejected"], True)
        reply = await client.write((0, 0, b"\1"), source="other")
        assert (reply.outcomes, "other" in reply.reasons[0]) == (["rejected"], True)


@in_loop
async def test_registers_that_are_not_published_are_not_written(
    segment: Segment, server: NatsServer, plant: Plant
) -> None:
    rule = FabricRule(match="cell", registers=["cell/other"])
    async with commander(segment, server.url, rule=[rule]) as client:
        assert (await client.write((0, 0, b"\1"))).outcomes == ["rejected"]
    assert plant.memory == bytes(8)


@in_loop
async def test_malformed_commands_are_counted(segment: Segment, server: NatsServer, plant: Plant) -> None:
    request = CommandRequest(1 << 62, 7, LAYOUT.hash[:8], [WriteItem(0, 0x81, b"\1")])
    async with commander(segment, server.url) as client:
        deep = b"\x81\xa1x" + b"\x91" * 100_000 + b"\xc0"
        huge = msgspec.msgpack.encode({"writes": [0] * 5000})
        hostile = [b"", b"\xff" * 100, b"\x81\xa6writes\xdd\xff\xff\xff\xff", b"{}", deep, huge]
        hostile.append(msgspec.msgpack.encode({"writes": []}))
        newer = msgspec.msgpack.encode({"injection": {"kind": "pause", "number": 1}})
        for data in (*hostile, encode_command(request), newer):
            reply = decode_reply(await client.send(data), 1)
            assert (reply.outcomes, CELL in reply.reasons[0]) == (["rejected"], True)
        assert client.uplink.commands.refused == len(hostile) + 2
        assert (await client.write((0, 0, b"\1"))).outcomes == ["written"], "others are served"


@in_loop
async def test_many_commands_at_once_each_have_an_outcome(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with commander(segment, server.url) as client:
        replies = await asyncio.gather(*(client.write((0, 0, bytes([count]))) for count in range(200)))
        assert {reply.outcomes[0] for reply in replies} <= {"written", "rejected"}
        assert sum(reply.outcomes == ["written"] for reply in replies) >= 100


@in_loop
async def test_only_the_owner_of_the_name_carries_out_commands(
    segment: Segment, server: NatsServer, plant: Plant
) -> None:
    """An uplink that has not claimed the cell yet may be a second one of the same name: its commands wait."""
    async with commander(segment, server.url) as client:
        found = client.uplink
        nats_client = found.publisher._client
        assert nats_client is not None
        found.publisher.end()
        writing = asyncio.create_task(client.write((0, 0, b"\1")))
        expiring = asyncio.create_task(client.write((1, 0, b"\1"), expires_ns=100_000_000))
        await asyncio.wait((writing, expiring), timeout=0.3)
        assert not writing.done()
        assert not expiring.done()
        assert plant.memory == bytes(8)
        found.publisher.begin(nats_client)
        assert (await writing).outcomes == ["written"]
        assert (await expiring).outcomes == ["expired"]
