"""aMQTT as our own broker, where there is no mosquitto: pure Python, in this process, MQTT 3.1.1."""

from __future__ import annotations

import asyncio
import logging
import ssl
from asyncio import StreamReader, StreamWriter
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from amqtt.adapters import BufferReader
from amqtt.mqtt.connect import ConnectPacket
from amqtt.plugins.base import BaseAuthPlugin
from amqtt.session import Session

from shmio.config import Address, Mqtt
from shmio.config.accounts import matches, read_accounts
from shmio.config.mqtttls import server_context
from shmio.endpoints.mqtt.hub import Hub
from shmio.endpoints.mqtt.place import SOCKET
from shmio.endpoints.mqtt.shares import MAX_CONNECTIONS, Refusals
from shmio.endpoints.mqtt.streams import BRIDGE, BridgesWriter, Reader, Writer, greeted
from shmio.errors import EndpointError
from shmio.worker import BEAT_S, Worker

GREETING_S: Final = 10.0
TOO_MANY: Final = f"client %s is refused: there are {MAX_CONNECTIONS}; for more, use another broker"
_LISTENER: Final = "default"
_NOT_AUTHORIZED: Final = b"\x20\x02\x00\x05"
"""MQTT 3.1.1, section 3.2: a CONNACK."""


class Everybody(BaseAuthPlugin):  # type: ignore[misc]  # the library's classes have no types
    """Admits everybody: who has no account does not come so far."""

    async def authenticate(self, *, session: Session) -> bool:  # noqa: ARG002  the library gives it
        """True."""
        return True


async def serve(worker: Worker, settings: Mqtt, place: Path) -> None:
    """Be the broker until told to stop. EndpointError: the address cannot be listened on; ConfigError."""
    accounts = read_accounts(settings.password_file) if settings.password_file else None
    logging.getLogger("amqtt").setLevel(logging.ERROR)
    logging.getLogger("transitions").setLevel(logging.ERROR)
    refusals = Refusals()
    broker = Hub(
        {
            "listeners": {_LISTENER: {"type": "external"}},
            "plugins": {f"{__name__}.{Everybody.__name__}": {}},
        },
        refusals,
    )
    await broker.start()
    address = Address.parse(str(settings.listen))
    context = server_context(settings.tls) if settings.tls else None
    connections = _Connections(broker, accounts, refusals)
    servers: list[asyncio.Server] = []
    try:
        servers.append(await asyncio.start_unix_server(connections.take_bridge, place / SOCKET))
        servers.append(await _listen(connections, address, context))
        worker.running()
        stopping = asyncio.Event()
        loop = asyncio.get_running_loop()
        worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
        while not stopping.is_set():
            worker.report((0, 0, refusals.count))
            try:
                await asyncio.wait_for(stopping.wait(), BEAT_S)
            except TimeoutError:
                continue
    finally:
        for server in servers:
            server.close()
        await broker.shutdown()


async def _listen(connections: _Connections, address: Address, context: ssl.SSLContext | None) -> asyncio.Server:
    try:
        return await asyncio.start_server(connections.take, address.host, address.port, ssl=context)
    except OSError as error:
        raise EndpointError(f"cannot listen on {address}: {error.strerror}") from None


class _Connections:
    """Gives the broker who connects, as many at once as there may be."""

    def __init__(self, broker: Hub, accounts: Mapping[str, str] | None, refusals: Refusals) -> None:
        """``accounts``: names and hashes of who may come by the address; None: anybody."""
        self._broker, self._accounts, self._refusals = broker, accounts, refusals
        self._open: set[StreamWriter] = set()

    async def take_bridge(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Of the UNIX socket."""
        await self._serve(reader, writer, BridgesWriter(writer, self._open, BRIDGE, self._refusals), None)

    async def take(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Of the address."""
        host, port, *_ = writer.get_extra_info("peername") or ("?", 0)
        client = f"{host}:{port}"
        if len(self._open) >= MAX_CONNECTIONS:
            self._refusals.tell(TOO_MANY, client)
            writer.close()
            return
        self._open.add(writer)
        try:
            await self._serve(reader, writer, Writer(writer, self._open, client, self._refusals), self._accounts)
        finally:
            self._open.discard(writer)

    async def _serve(
        self, reader: StreamReader, writer: StreamWriter, adapter: Writer, accounts: Mapping[str, str] | None
    ) -> None:
        try:
            begun = await asyncio.wait_for(greeted(reader, writer), GREETING_S)
            # Before the library sees it: that would end whoever has the client's name, and only then ask who it is.
            if begun is not None and accounts is not None and not await _is_known(begun, accounts):
                writer.write(_NOT_AUTHORIZED)
            elif begun is not None:
                taken = Reader(reader, begun, adapter.client, self._refusals)
                await self._broker.external_connected(taken, adapter, _LISTENER)
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            pass  # it is gone, or speaks something else
        finally:
            writer.close()


async def _is_known(connect: bytes, accounts: Mapping[str, str]) -> bool:
    """Whether a CONNECT has the name and the password of an account."""
    try:
        packet = await ConnectPacket.from_stream(BufferReader(connect))
        name, password = packet.username or "", packet.password or ""
    except Exception:  # noqa: BLE001 - whatever the library makes of garbage, it is nobody's account
        return False
    secret = accounts.get(name)
    return secret is not None and await asyncio.to_thread(matches, password, secret)
