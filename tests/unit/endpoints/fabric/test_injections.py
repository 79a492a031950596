"""Injections of other cells: what a bare NATS client gets, what the source does, and when leases end."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import nats
import pytest

from shmio.audit import trail
from shmio.audit.file import AuditSettings
from shmio.config import Declaration
from shmio.config.model import FabricAllow, FabricRule
from shmio.connectors.injection_layers import Owner
from shmio.endpoints.fabric import commands, injections
from shmio.endpoints.fabric.uplink import Uplink
from shmio.fabric.messages import (
    STATE_REQUEST,
    CommandReply,
    CommandRequest,
    InjectionRequest,
    SourceState,
    WriteItem,
    decode_reply,
    decode_state,
    encode_command,
)
from shmio.layout.values.write import Write
from shmio.local.writer import SourceWriter
from shmio.segment import CommandKind, Event, EventKind, Segment
from shmio.segment._atomics import REASON_SIZE
from tests.nats_server import NatsServer
from tests.unit.endpoints.fabric.harness import CELL, TIMEOUT_S, Listener, decoded, in_loop, listening, until, uplink
from tests.unit.endpoints.plant import GUEST, Plant

ALLOW = [FabricAllow(sender="plant1.*.twin", roles=["inject"]), FabricAllow(sender="plant1.*.*", roles=["write"])]
TWIN = "plant1.line1.twin"
OTHER = WriteItem(4, 0, b"\xff\xff\xff\xff")
NUMBER = 4711 << 40 | 5


@pytest.fixture
def plant(segment: Segment) -> Iterator[Plant]:
    plant = Plant(segment.writer("cell"))
    writer = segment.processes.find("fabric").writer
    assert writer is not None
    plant.owners[writer] = Owner(writer, 1)
    plant.cycle()
    plant.run()
    yield plant
    plant.stop()


class Injector:
    """A bare NATS client that sends commands about injections to an uplink."""

    def __init__(self, client: Any, found: Uplink) -> None:
        self.client, self.uplink = client, found
        self.block = found._feeds["cell"].block

    async def send(self, kind: Any, number: int = 0, sender: str = TWIN, **more: Any) -> CommandReply:
        """Send a command, and return its outcomes."""
        now_ns = self.uplink._log_time(time.monotonic_ns())
        stream, digest = self.uplink.backlog.rows["cell"].stream, self.uplink._feeds["cell"].digest[:8]
        injection = InjectionRequest(kind, number, **more)
        request = CommandRequest(now_ns + 60_000_000_000, stream, digest, injection=injection)
        subject = f"shmio.{CELL}.cell.command.{sender}"
        reply = await self.client.request(subject, encode_command(request), timeout=TIMEOUT_S)
        return decode_reply(bytes(reply.data), request.outcomes)

    async def declare(self, number: int = NUMBER, sender: str = TWIN, **more: Any) -> CommandReply:
        """Declare an injection over the register ``other``."""
        values = {"name": "one", "target": "cell/other", "operation": "set", "value": 9, **more}
        declaration = msgspec.json.encode(msgspec.convert(values, Declaration))
        return await self.send("declare", number, sender, declaration=declaration)

    @property
    def leases(self) -> injections.Leases:
        return self.uplink.commands.client(self.uplink._feeds["cell"]).leases

    @property
    def present(self) -> list[int]:
        return [one.number for one in self.block.injections.read()]


@asynccontextmanager
async def injector(segment: Segment, url: str, **settings: Any) -> AsyncIterator[Injector]:
    async with uplink(segment, url, **{"allow": ALLOW, **settings}) as found:
        client = await nats.connect(url)
        await until(lambda: found.publisher.up)
        try:
            yield Injector(client, found)
        finally:
            await client.close()


async def next_state(listener: Listener) -> SourceState:
    """Return the next state that the uplink publishes."""
    while True:
        message = await listener.queue.get()
        if (state := decode_state(bytes(message.data))) is not None:
            return state


async def kinds_until(listener: Listener, kind: EventKind) -> list[object]:
    """Return the states and the kinds of the events up to the first event of this kind."""
    found: list[object] = []
    while kind not in found:
        message = await listener.queue.get()
        state = decode_state(bytes(message.data))
        found += [one.kind for one in decoded(message).entries if isinstance(one, Event)]
        found += [] if state is None else [[one.number for one in state.injections]]
    return found


@in_loop
async def test_a_shadow_of_another_cell_lives_at_the_owner(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with injector(segment, server.url) as twin, listening(server.url) as listener:
        assert await twin.send("inject", NUMBER, items=[OTHER], name="test") == CommandReply(["injected"], [""])
        assert await kinds_until(listener, EventKind.INJECTED) == [[NUMBER], EventKind.INJECTED], "the list comes first"
        values = [WriteItem(4, 0, b"\0\0\0\7"), WriteItem(0, 0, b"\1")]
        reply = await twin.send("shadow", NUMBER + 1, injection=NUMBER, items=values[:1])
        assert reply == CommandReply(["shadowed"], [""])
        frame = twin.block.latest()
        assert frame is not None
        assert frame.image[4:] == b"\0\0\0\7"
        reply = await twin.send("shadow", NUMBER + 2, injection=NUMBER, items=values)
        assert reply.outcomes == ["rejected"] * 2, "the injection does not cover the other register"
        assert await twin.send("lift", NUMBER + 3, injection=NUMBER) == CommandReply(["lifted"], [""])
        assert (await twin.send("lift", NUMBER + 4, injection=NUMBER)).outcomes == ["rejected"]
        assert twin.present == []


@in_loop
async def test_a_declared_injection_has_the_number_that_the_sender_chose(
    segment: Segment, server: NatsServer, plant: Plant
) -> None:
    async with injector(segment, server.url) as twin, listening(server.url) as listener:
        assert (await twin.declare()).outcomes == ["injected"]
        [one] = twin.block.injections.read()
        assert (one.number, one.name) == (NUMBER, "one")
        assert [(one.number, one.cell) for one in (await next_state(listener)).injections] == [(NUMBER, TWIN)]
        reply = await twin.declare()
        assert (reply.outcomes, "exists" in reply.reasons[0]) == (["rejected"], True)
        reply = await twin.declare(NUMBER + 1, target="cell/nothing")
        assert (reply.outcomes, "cell/nothing" in reply.reasons[0]) == (["rejected"], True)


@in_loop
async def test_the_role_is_needed_and_the_audit_names_the_sender(
    segment: Segment, server: NatsServer, plant: Plant, tmp_path: Path
) -> None:
    file = tmp_path / "audit.jsonl"
    trail.open_trail(AuditSettings(str(file), 1 << 20, 2), segment.instance, "fabric")
    try:
        async with injector(segment, server.url) as twin:
            reply = await twin.declare(sender="plant1.line1.writer")
            assert reply.outcomes == ["rejected"]
            for word in ("[[fabric.allow]]", "plant1.line1.writer", "'inject'", "supervisor.toml", CELL):
                assert word in reply.reasons[0]
            reply = await twin.declare(sender="plant7.line1.unnamed")
            for word in ("lines [[fabric.allow]]", 'sender = "plant7.line1.unnamed"', 'roles = ["inject"]'):
                assert word in reply.reasons[0]
            assert reply.reasons[0].endswith("reload it")
            assert len(reply.reasons[0]) <= REASON_SIZE
            await twin.declare()
            await twin.send("lift", 7, injection=NUMBER)
    finally:
        trail.close_trail()
    entries = [json.loads(line) for line in file.read_text().splitlines()]
    assert entries[-1]["reason"] == ""
    assert [(one["who"], one["action"], one["outcome"]) for one in entries] == [
        ("plant1.line1.writer", "declare", "denied"),
        ("plant7.line1.unnamed", "declare", "denied"),
        (TWIN, "declare", "injected"),
        (TWIN, "lift", "lifted"),
    ]


@in_loop
async def test_an_injection_that_is_not_renewed_is_lifted(
    segment: Segment, server: NatsServer, plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(injections, "LEASE_S", 2.0)
    async with injector(segment, server.url) as twin:
        await twin.declare(NUMBER)
        await twin.declare(NUMBER + 1, name="renewed")
        await twin.send("inject", NUMBER + 2, items=[OTHER], keep=True)
        async with asyncio.timeout(TIMEOUT_S):
            while NUMBER in twin.present:
                assert (await twin.send("renew", renewed=[NUMBER + 1])).outcomes == ["accepted"]
                await twin.send("renew", sender="plant1.line2.twin", renewed=[NUMBER])
        assert twin.present == [NUMBER + 1, NUMBER + 2]
        await until(lambda: twin.present == [NUMBER + 2])


@in_loop
async def test_only_what_is_published_is_changed_and_read(segment: Segment, server: NatsServer, plant: Plant) -> None:
    rule = FabricRule(match="cell", registers=["cell/other"])
    async with injector(segment, server.url, rule=[rule]) as twin:
        refused = [
            await twin.declare(target="cell/count"),
            await twin.declare(target="cell/**"),
            await twin.declare(when="cell/count > 3"),
            await twin.send("inject", NUMBER, items=[WriteItem(0, 0, b"\1")]),
        ]
        assert [one.outcomes for one in refused] == [["rejected"]] * 4
        assert twin.present == []
        assert (await twin.declare(when="cell/other = 0")).outcomes == ["injected"]


@in_loop
async def test_what_is_not_published_does_not_leave_through_injections(
    segment: Segment, server: NatsServer, plant: Plant
) -> None:
    """A program of the owner's host injects into registers of which only one is published."""
    rule = FabricRule(match="cell", registers=["cell/other"])
    own = SourceWriter(segment.blocks["cell"], GUEST)
    values = {"name": "one", "target": "cell/**", "operation": "set", "value": 9, "when": "cell/count = 4711"}
    declaration = msgspec.json.encode(msgspec.convert(values, Declaration))
    async with injector(segment, server.url, rule=[rule]), listening(server.url) as listener:
        own.forward(NUMBER, CommandKind.DECLARE, [Write(0, 0, declaration)], 20.0, 0, keep=True)
        [entry] = (await next_state(listener)).injections
        assert (entry.name, entry.ranges) == ("one", ((4, 4, 0xFF),))
        assert entry.running is not None
        assert msgspec.json.encode(entry.running.declaration) == msgspec.json.encode(
            Declaration(name="one", target=["cell/other"], operation="set")
        )
        for number, when in enumerate(("cell/count = 4711", "cell/other = 4711"), NUMBER + 10):
            more = {"name": f"n{number}", "target": "cell/other", "when": when}
            declaration = msgspec.json.encode(msgspec.convert(values | more, Declaration))
            own.forward(number, CommandKind.DECLARE, [Write(0, 0, declaration)], 20.0, 0, keep=True)
        while len(entries := (await next_state(listener)).injections) < 3:
            pass
        shown = {one.number: one.running.declaration.when for one in entries if one.running is not None}
        assert shown == {NUMBER: None, NUMBER + 10: None, NUMBER + 11: "cell/other = 4711"}
        own.forward(NUMBER + 1, CommandKind.INJECT, [Write(0, 0, b"\xff" * 8)], 20.0, 0, name="two", keep=True)
        shadow = [Write(0, 0, b"\0\0\x12\x67"), Write(4, 0, b"\0\0\0\7")]
        own.forward(NUMBER + 2, CommandKind.SHADOW, shadow, 20.0, NUMBER + 1)
        data: dict[tuple[int, int], bytes] = {}
        while (EventKind.SHADOWED, 4) not in data:
            message = decoded(await listener.queue.get())
            data |= {(one.kind, one.offset): one.data for one in message.entries if isinstance(one, Event)}
        assert data[EventKind.INJECTED, 0] == b""
        assert (data[EventKind.SHADOWED, 0], data[EventKind.SHADOWED, 4]) == (b"", b"\0\0\0\7")


@in_loop
async def test_a_mirror_gets_the_state_that_it_asks_for(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with injector(segment, server.url) as twin:
        await twin.declare()
        async with listening(server.url) as listener:
            await listener.client.publish(f"shmio.{CELL}.cell.missing", msgspec.json.encode(STATE_REQUEST))
            state = await next_state(listener)
    assert [one.number for one in state.injections] == [NUMBER]
    assert not state.virtual
    assert state.clock_ns > 0


@in_loop
async def test_malformed_commands_are_counted(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with injector(segment, server.url) as twin:
        hostile: list[dict[str, Any]] = [
            {"kind": "inject", "number": 0, "items": [OTHER]},
            {"kind": "inject", "number": 1},
            {"kind": "inject", "number": 1, "items": [OTHER], "direction": 2},
            {"kind": "inject", "number": 1, "items": [OTHER], "priority": 1 << 40},
            {"kind": "inject", "number": 1, "items": [OTHER], "name": "x" * 300},
            {"kind": "declare", "number": 1},
            {"kind": "lift", "number": 1},
            {"kind": "renew", "renewed": list(range(1000))},
            {"kind": "other", "number": 1},
        ]

        def refused(count: int) -> bool:
            return twin.uplink.commands.refused == count

        for number, one in enumerate(hostile, 1):
            request = CommandRequest(1 << 62, 1, b"12345678", injection=InjectionRequest(**one))
            await twin.client.publish(f"shmio.{CELL}.cell.command.{TWIN}", encode_command(request), reply="reply")
            try:
                await until(partial(refused, number))
            except TimeoutError:
                pytest.fail(f"not refused: {one}")
        assert twin.present == []


@in_loop
async def test_a_number_is_used_once(
    segment: Segment, server: NatsServer, plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second command of the same number, also of another cell, leaves the injection and its lease as they are."""
    async with injector(segment, server.url, allow=[FabricAllow(sender="*.*.*", roles=["inject"])]) as twin:
        await twin.declare(NUMBER)
        reply = await twin.declare(NUMBER, sender="plant1.line9.other", name="two")
        assert (reply.outcomes, "exists" in reply.reasons[0]) == (["rejected"], True)
        reply = await twin.send("inject", NUMBER, "plant1.line9.other", items=[OTHER])
        assert (reply.outcomes, "exists" in reply.reasons[0]) == (["rejected"], True)
        assert twin.leases.sender_of(NUMBER) == TWIN
        monkeypatch.setattr(injections, "LEASE_S", 0.6)
        await until(lambda: twin.present == [])


@in_loop
async def test_a_list_that_cannot_be_read_ends_no_lease(
    segment: Segment, server: NatsServer, plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The source may be interrupted while it writes its list."""
    async with injector(segment, server.url) as twin:
        await twin.declare()
        state = twin.uplink.commands.client(twin.uplink._feeds["cell"]).state
        monkeypatch.setattr(type(twin.block.injections), "try_read", lambda _: None)
        monkeypatch.setattr(injections, "CHECK_S", 0.0)
        state.wanted = True
        assert twin.leases.expired() == []
        assert state.read() is None, "no empty list is published"
        monkeypatch.undo()
        assert twin.leases.sender_of(NUMBER) == TWIN
        shown = state.read()
        assert shown is not None
        assert [one.number for one in shown.injections] == [NUMBER]


@in_loop
async def test_a_restored_injection_is_lifted_unless_a_cell_renews_it(
    segment: Segment, server: NatsServer, plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A snapshot brings back injections that the uplink knows nothing of any more."""
    monkeypatch.setattr(injections, "LEASE_S", 2.0)
    async with injector(segment, server.url) as twin:
        await twin.send("inject", NUMBER, items=[OTHER])
        await twin.send("inject", NUMBER + 1, items=[OTHER])
        processor = plant.commands.injections
        with plant.output.lock:
            saved = processor.save()
        await until(lambda: NUMBER not in twin.leases and NUMBER + 1 not in twin.leases)
        assert twin.present == []
        restore = processor.prepare_restore(saved, processor.injections.now, plant.output.base)
        with plant.output.lock:
            restore()
        assert len(twin.present) == 2
        async with asyncio.timeout(TIMEOUT_S):
            while NUMBER in twin.present:
                await twin.send("renew", renewed=[NUMBER + 1])
        assert twin.present == [NUMBER + 1]
        assert twin.leases.sender_of(NUMBER + 1) == TWIN
        await until(lambda: twin.present == [])


@in_loop
async def test_requests_for_the_state_cannot_push_messages_out(
    segment: Segment, server: NatsServer, plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with injector(segment, server.url) as twin, listening(server.url) as listener:
        await twin.declare()
        row = twin.uplink.backlog.rows["cell"]
        made = 0
        put = twin.uplink.backlog.put

        def counted(row: Any, kept: Any) -> None:
            nonlocal made
            made += decode_state(bytes(kept.data)) is not None
            put(row, kept)

        monkeypatch.setattr(twin.uplink.backlog, "put", counted)
        begun_s = time.monotonic()
        for _ in range(300):
            await listener.client.publish(f"shmio.{CELL}.cell.missing", msgspec.json.encode(STATE_REQUEST))
        await listener.client.flush()
        await twin.send("renew", renewed=[NUMBER])  # the uplink has had all requests
        state = twin.uplink.commands.client(twin.uplink._feeds["cell"]).state
        await until(lambda: not state.wanted)
        assert 1 <= made <= 2 + (time.monotonic() - begun_s) / injections.ASKED_S
        assert row.find(1) is not None, "nothing was pushed out"


@in_loop
async def test_a_refused_renewal_says_why(segment: Segment, server: NatsServer, plant: Plant) -> None:
    async with injector(segment, server.url) as twin:
        reply = await twin.send("renew", sender="plant1.line1.writer", renewed=[NUMBER])
        assert (reply.outcomes, "'inject'" in reply.reasons[0]) == (["rejected"], True)


@in_loop
async def test_a_check_that_fails_is_answered(
    segment: Segment, server: NatsServer, plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> str:
        raise ZeroDivisionError

    monkeypatch.setattr(commands, "declaration_refusal", broken)
    async with injector(segment, server.url) as twin:
        reply = await twin.declare()
        assert (reply.outcomes, "ZeroDivisionError" in reply.reasons[0]) == (["rejected"], True)


@in_loop
async def test_a_cell_without_the_role_cannot_fill_the_audit_log(
    segment: Segment, server: NatsServer, plant: Plant, tmp_path: Path
) -> None:
    file = tmp_path / "audit.jsonl"
    trail.open_trail(AuditSettings(str(file), 1 << 20, 2), segment.instance, "fabric")
    try:
        async with injector(segment, server.url) as twin:
            false = msgspec.json.encode({"source": "press", "paths": ["press/force"], "x": "y" * 100})
            for number in range(50):
                await twin.send("declare", number + 1, "plant1.line1.writer", declaration=false)
            await twin.send("declare", 99, declaration=false)
            await twin.declare()
    finally:
        trail.close_trail()
    entries = [json.loads(line) for line in file.read_text().splitlines()]
    denied = [one for one in entries if one["outcome"] == "denied"]
    assert {json.dumps(one["what"]) for one in denied} == {'{"source": "cell"}'}
    assert sum(one["count"] for one in denied) == 50
    assert len(denied) < 25
    wrong, right = (one["what"] for one in entries if one["outcome"] != "denied")
    assert wrong == {"source": "cell", "keep": False}
    assert (right["source"], right["target"]) == ("cell", "cell/other")
