"""Connections to servers that end them with an error, or that offer no TLS."""

from __future__ import annotations

import asyncio
import gc
from contextlib import suppress

import pytest
from nats.errors import Error

from shmio.config.model import MqttTls
from shmio.errors import RemoteError
from shmio.fabric.client import FabricClient
from shmio.fabric.connection import Access, connect, connect_or_stop, refusal
from shmio.fabric.tasks import end
from shmio.testing.ports import reserved_port

TIMEOUT_S = 20


@pytest.mark.parametrize("error", ["User Authentication Expired", "Authorization Violation", "Slow Consumer"])
def test_a_connection_that_the_server_ends_comes_back(error: str) -> None:
    """The first connection ends with an error; the library would give up, and never tell."""

    async def work() -> None:
        back = asyncio.Event()
        served: list[asyncio.StreamWriter] = []

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            served.append(writer)
            writer.write(b'INFO {"server_id": "x", "version": "2.10.0", "max_payload": 1000}\r\n')
            while line := await reader.readline():
                if line.startswith(b"PING"):
                    writer.write(b"PONG\r\n")
                    if len(served) == 1:
                        writer.write(f"-ERR '{error}'\r\n".encode())
            writer.close()

        async def restored() -> None:
            back.set()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        url = f"nats://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        client = await connect(Access((url,)), "test", back=restored)
        await asyncio.wait_for(back.wait(), TIMEOUT_S)
        assert client.is_connected
        await client.close()
        server.close()
        await server.wait_closed()

    asyncio.run(work())


def test_a_confirmation_ends_when_the_connection_is_lost() -> None:
    async def work() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b'INFO {"server_id": "x", "version": "2.10.0", "max_payload": 1000}\r\n')
            pings = 0
            while pings < 2 and (line := await reader.readline()):
                if line.startswith(b"PING"):
                    pings += 1
                    if pings == 1:
                        writer.write(b"PONG\r\n")
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        url = f"nats://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        client = await connect(Access((url,)), "test")
        with pytest.raises(Error):
            await asyncio.wait_for(client.confirm(), TIMEOUT_S)
        await client.close()
        server.close()
        await server.wait_closed()

    asyncio.run(work())


@pytest.mark.parametrize(("scheme", "tls"), [("tls", None), ("nats", MqttTls()), ("tls", MqttTls())])
def test_a_server_without_tls_gets_nothing_if_tls_is_required(scheme: str, tls: MqttTls | None) -> None:
    """The server says what it offers in plain text, so somebody on the way can say that there is no TLS."""
    received: list[bytes] = []

    async def work() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b'INFO {"server_id": "x", "version": "2.10.0", "max_payload": 1000}\r\n')
            received.append(await reader.read())
            writer.close()
            await writer.wait_closed()
            ended.set()

        ended = asyncio.Event()
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        url = f"{scheme}://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        with pytest.raises(RemoteError, match="TLS"):
            await connect(Access((url,), tls), "test", patient=False)
        await asyncio.wait_for(ended.wait(), TIMEOUT_S)
        server.close()
        await server.wait_closed()

    asyncio.run(work())
    assert set(received) == {b""}


@pytest.mark.parametrize(("version", "works"), [("2.9.10", False), ("2.10.0-beta", True), ("3.0.0", True)])
def test_a_server_that_is_too_old_is_refused(version: str, works: bool) -> None:
    """Debian 12 has 2.9.10, whose answers have no time: a process that used it ended with a traceback."""

    async def work() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(f'INFO {{"server_id": "x", "version": "{version}", "max_payload": 1000}}\r\n'.encode())
            while line := await reader.readline():
                if line.startswith(b"PING"):
                    writer.write(b"PONG\r\n")
            writer.close()
            await writer.wait_closed()
            ended.set()

        ended = asyncio.Event()
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        access = Access((f"nats://127.0.0.1:{server.sockets[0].getsockname()[1]}",))
        if works:
            await (await connect(access, "test", patient=False)).leave()
        else:
            with pytest.raises(RemoteError, match=r"NATS 2\.9\.10, but the fabric needs 2\.10 or later; upgrade"):
                await connect(access, "test", patient=False)
        await asyncio.wait_for(ended.wait(), TIMEOUT_S)
        server.close()
        await server.wait_closed()

    asyncio.run(work())


def test_what_a_server_refuses_is_said_with_the_remedy() -> None:
    own, seed = Access(("nats://a",)), Access(("nats://a",), credentials="x.seed")
    allow = "if an instance runs the server, name the cell in its [[fabric.allow]]"
    for access, subject, words in (
        (own, "$KV.shmio_layouts.ab12", f"this user may not publish as p.l.c; use the seed of this cell; {allow}"),
        (own, "$KV.shmio_cells.p.l.c", f"this user may not publish as p.l.c; use the seed of this cell; {allow}"),
        (own, "shmio.p.l.c.s.live", f"this user may not publish as p.l.c; use the seed of this cell; {allow}"),
        (
            seed,
            "$KV.shmio_layouts.ab12",
            "the user of the credentials in x.seed may not publish as p.l.c; use the seed",
        ),
        (own, "$JS.API.STREAM.CREATE.shmio~p~l~c", "may not create histories; use admin.seed"),
        (own, "$JS.API.CONSUMER.CREATE.shmio~p~l~c", "if an instance runs the server, be its user on its host"),
    ):
        said = f'nats: permissions violation for publish to "{subject.lower()}"'
        assert words in refusal(access, said, "p.l.c"), subject


@pytest.mark.parametrize("connects", [True, False])
def test_waiting_for_a_server_can_be_stopped_although_a_cancellation_is_lost(
    connects: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    clients: list[FabricClient] = []

    async def work() -> None:
        stop = asyncio.Event()

        async def connect(client: FabricClient, **_: object) -> None:
            clients.append(client)
            stop.set()
            with suppress(asyncio.CancelledError):
                await asyncio.Event().wait()
            if not connects:
                await asyncio.Event().wait()

        async def close(client: FabricClient) -> None:
            clients.remove(client)

        monkeypatch.setattr(FabricClient, "connect", connect)
        monkeypatch.setattr(FabricClient, "close", close)
        assert await asyncio.wait_for(connect_or_stop(Access(("nats://127.0.0.1:1",)), "x", stop), TIMEOUT_S) is None
        assert stop.is_set()
        assert not clients, "the connection stays open"

    asyncio.run(work())


@pytest.mark.parametrize("greets", [False, True])
def test_a_connection_is_closed_if_the_wait_for_its_server_is_cancelled(greets: bool) -> None:
    """The server accepts the connection, and never answers a ping."""

    async def work() -> None:
        came, left = asyncio.Event(), asyncio.Event()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            if greets:
                writer.write(b'INFO {"server_id": "x", "version": "2.10.0", "max_payload": 1000}\r\n')
                await reader.readline()
            came.set()
            with suppress(ConnectionError):
                await reader.read()
            left.set()
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        url = f"nats://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        connecting = asyncio.create_task(connect(Access((url,)), "test"))
        await asyncio.wait_for(came.wait(), TIMEOUT_S)
        gc.disable()  # which would close the connection, too, with a warning
        try:
            await end(connecting)
            await asyncio.wait_for(left.wait(), TIMEOUT_S)
        finally:
            gc.enable()
        server.close()
        await server.wait_closed()

    asyncio.run(work())


def test_the_reason_is_in_words() -> None:
    with reserved_port() as place, pytest.raises(RemoteError, match=r"can be reached: connection refused$"):
        asyncio.run(connect(Access((f"nats://{place}",)), "test", patient=False))
