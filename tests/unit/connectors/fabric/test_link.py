"""The connection of a mirror to a real server."""

from __future__ import annotations

import asyncio
import logging
import threading
from pathlib import Path

import nats
import pytest
from nats.aio.msg import Msg

from shmio.config import Address
from shmio.connectors.fabric.link import Link
from shmio.connectors.fabric.order import Missing
from shmio.fabric.connection import Access
from shmio.fabric.messages import CommandRequest, WriteItem
from shmio.fabric.names import CellName
from shmio.testing.cell import until
from shmio.testing.proxy import FaultProxy
from tests.nats_server import Link as Proxy
from tests.nats_server import nats_server

PATIENCE_S = 20.0


def test_a_dead_link_does_not_keep_the_process_from_stopping(tmp_path: Path) -> None:
    with nats_server(tmp_path / "nats") as server:
        proxy = Proxy(server.port)
        owner, sender = CellName.parse("plant1.line3.a50"), CellName.parse("plant1.line3.twin")
        link = Link(Access((proxy.url,)), owner, "cell", "test", sender, lambda _: None, lambda _: None)
        link.start()
        until(lambda: not link.problem, "the link is connected", PATIENCE_S)
        proxy.cut()
        for _ in range(12):  # more than the buffers of the sockets hold
            link.command(CommandRequest(1, 7, bytes(8), [WriteItem(0, 0, bytes(900_000))]), 2.0)
        closing = threading.Thread(target=link.close, daemon=True)
        closing.start()
        closing.join(PATIENCE_S)
        assert not closing.is_alive()
        proxy.close()


def test_a_normal_stop_is_no_lost_connection(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with nats_server(tmp_path / "nats") as server, caplog.at_level(logging.INFO, "shmio.source"):
        owner = CellName.parse("plant1.line3.a50")
        link = Link(Access((server.url,)), owner, "cell", "test", None, lambda _: None, lambda _: None)
        link.start()
        until(lambda: not link.problem, "the link is connected", PATIENCE_S)
        link.close()
    assert [record.getMessage() for record in caplog.records] == [f"connected to the fabric at {server.url}"]


def test_an_answer_that_a_stalled_connection_delays_is_not_lost(tmp_path: Path) -> None:
    owner, came, ready, ends = CellName.parse("plant1.line3.a50"), threading.Event(), threading.Event(), asyncio.Event()
    received: list[bytes] = []

    async def answer(url: str) -> None:
        client = await nats.connect(url)

        async def take(message: Msg) -> None:
            await client.publish(message.reply, b"missing")
            await client.publish(message.reply, b"")
            came.set()

        await client.subscribe(owner.missing("cell"), cb=take)
        await client.flush()
        ready.set()
        await ends.wait()
        await client.close()

    with nats_server(tmp_path / "nats") as server, FaultProxy(Address("127.0.0.1", server.port), framing=len) as proxy:
        loop = asyncio.new_event_loop()
        thread = threading.Thread(target=loop.run_until_complete, args=(answer(server.url),))
        url = f"nats://{proxy.address}"
        answered = threading.Event()
        link = Link(Access((url,)), owner, "cell", "test", None, received.append, lambda _: answered.set())
        thread.start()
        link.start()
        try:
            until(lambda: not link.problem, "the link is connected", PATIENCE_S)
            assert ready.wait(PATIENCE_S)
            proxy.hold()
            link.request(Missing(7, 1, 1))
            assert came.wait(PATIENCE_S)
            until(lambda: link.stalled, "the link waits for the server", PATIENCE_S)
            assert link.connected
            proxy.release()
            assert answered.wait(PATIENCE_S)
            assert received == [b"missing"]
        finally:
            link.close()
            loop.call_soon_threadsafe(ends.set)
            thread.join(PATIENCE_S)
            loop.close()
