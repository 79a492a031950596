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
from shmio.config.mqtt.accounts import matches, read_accounts
from shmio.config.mqtt.tls import server_context
from shmio.endpoints.mqtt.broker.access import BRIDGE, EVERYTHING, Guest, Rights, new_secret, rights
from shmio.endpoints.mqtt.broker.amqtt_bounds import Hub
from shmio.endpoints.mqtt.broker.amqtt_shares import MAX_CONNECTIONS, Refusals
from shmio.endpoints.mqtt.broker.amqtt_streams import PEER, BridgesWriter, Reader, Writer, greeted
from shmio.endpoints.mqtt.broker.directory import SOCKET
from shmio.errors import EndpointError
from shmio.worker import BEAT_S, Worker

GREETING_S: Final = 10.0
TOO_MANY: Final = f"client %s is refused: there are {MAX_CONNECTIONS}; for more, use another broker"
_LISTENER: Final = "default"
_NOT_AUTHORIZED: Final = b"\x20\x02\x00\x05"
"""MQTT 3.1.1, section 3.2: a CONNACK."""


class Everybody(BaseAuthPlugin):  # type: ignore[misc]  # the library's classes have no types
    """Admits everybody: who may not come in does not come so far."""

    async def authenticate(self, *, session: Session) -> bool:  # noqa: ARG002  the library gives it
        """True."""
        return True


async def serve(worker: Worker, settings: Mqtt, place: Path) -> None:
    """Be the broker until told to stop. EndpointError: the address cannot be listened on; ConfigError."""
    accounts = read_accounts(settings.password_file, settings.account) if settings.password_file else None
    given = rights(settings, worker.segment.instance, accounts)
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
    connections = _Connections(broker, accounts, given, {BRIDGE: new_secret(place)}, refusals)
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

    def __init__(
        self,
        broker: Hub,
        accounts: Mapping[str, str] | None,
        given: Mapping[str | None, Rights],
        bridge: Mapping[str, str],
        refusals: Refusals,
    ) -> None:
        """``accounts``: names and hashes of who may come by the address, None: anybody; ``given``: what they may do.

        ``bridge``: the account that comes by the UNIX socket.
        """
        self._broker, self._refusals = broker, refusals
        self._guests = _Door(accounts, given)
        self._bridge = _Door(bridge, {BRIDGE: EVERYTHING})
        self._open: set[StreamWriter] = set()

    async def take_bridge(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Of the UNIX socket."""
        await self._serve(reader, writer, BridgesWriter(writer, self._open, PEER, self._refusals), self._bridge)

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
            await self._serve(reader, writer, Writer(writer, self._open, client, self._refusals), self._guests)
        finally:
            self._open.discard(writer)

    async def _serve(self, reader: StreamReader, writer: StreamWriter, adapter: Writer, door: _Door) -> None:
        try:
            begun = await asyncio.wait_for(greeted(reader, writer), GREETING_S)
            # Before the library sees it: that would end whoever has the client's name, and only then ask who it is.
            guest = None if begun is None else await door.ask(begun)
            if begun is None:
                return
            if guest is None or not self._broker.lets(guest):
                writer.write(_NOT_AUTHORIZED)
            else:
                taken = Reader(reader, begun, adapter.client, self._refusals, guest)
                await self._broker.external_connected(taken, adapter, _LISTENER)
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            pass  # it is gone, or speaks something else
        finally:
            writer.close()


class _Door:
    """Asks who connects by one way."""

    def __init__(self, accounts: Mapping[str, str] | None, given: Mapping[str | None, Rights]) -> None:
        self._accounts, self._given = accounts, given

    async def ask(self, connect: bytes) -> Guest | None:
        """Who has sent a CONNECT; None: nobody who is let in."""
        try:
            packet = await ConnectPacket.from_stream(BufferReader(connect))
            client_id, name, password = packet.client_id or "", packet.username, packet.password or ""
        except Exception:  # noqa: BLE001 - whatever the library makes of garbage, it shows no account
            client_id, name, password = "", None, ""
        if self._accounts is None:
            name = None  # it is not asked whose
        if name is not None:
            secret = (self._accounts or {}).get(name)
            if secret is None or not await asyncio.to_thread(matches, password, secret):
                return None
        return Guest(name, client_id, self._given[name]) if name in self._given else None
