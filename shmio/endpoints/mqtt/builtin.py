"""aMQTT as our own broker, where there is no mosquitto: pure Python, in this process, MQTT 3.1.1."""

from __future__ import annotations

import asyncio
import logging
import ssl
from asyncio import StreamReader, StreamWriter
from collections.abc import Collection
from pathlib import Path
from typing import Final

from amqtt.adapters import StreamReaderAdapter, StreamWriterAdapter
from amqtt.broker import Broker
from amqtt.errors import MQTTError
from amqtt.plugins.base import BaseAuthPlugin
from amqtt.session import Session

from shmio.config import Address, Mqtt
from shmio.config.accounts import matches, read_accounts
from shmio.config.mqtttls import server_context
from shmio.endpoints.mqtt.mosquitto import MAX_PACKET_BYTES
from shmio.endpoints.mqtt.place import SOCKET
from shmio.errors import EndpointError
from shmio.worker import BEAT_S, Worker

MAX_CONNECTIONS: Final = 256
MAX_UNREAD_BYTES: Final = 8 << 20
"""That may wait for one client: several packets of the largest kind."""
UNREAD_BYTES: Final = 64 << 20
"""That may wait for all of them."""
GREETING_S: Final = 10.0
_CONNECT: Final = 0x10
_UNSUPPORTED: Final = b"\x20\x03\x00\x84\x00"
"""MQTT 5.0, section 3.2: a CONNACK that refuses the protocol's version."""
_BRIDGE: Final = "bridge"
_LISTENER: Final = "default"

accounts: dict[str, str] | None = None
"""Names and hashes of who may connect; None: anybody. The library makes its plugins itself, so they find it here."""

log = logging.getLogger("shmio.mqtt")


class Accounts(BaseAuthPlugin):  # type: ignore[misc]  # the library's classes have no types
    """Admits the bridge, and who has an account."""

    async def authenticate(self, *, session: Session) -> bool:
        """Whether who has connected is one of them."""
        if accounts is None or session.remote_address == _BRIDGE:
            return True
        name, password = session.username or "", session.password or ""
        secret = accounts.get(name)
        return secret is not None and await asyncio.to_thread(matches, password, secret)


class _Broker(Broker):  # type: ignore[misc]
    """Sends a client what is retained for its own subscriptions alone; aMQTT sends who connects that of everybody's."""

    async def _publish_retained_messages_for_subscription(
        self, subscription: tuple[str, int], session: Session
    ) -> None:
        if any(whose.client_id == session.client_id for whose, _ in self._subscriptions.get(subscription[0], ())):
            await super()._publish_retained_messages_for_subscription(subscription, session)


class _Reader(StreamReaderAdapter):  # type: ignore[misc]
    """Takes no packet that is too large. ``begun``: what was read before."""

    def __init__(self, reader: StreamReader, begun: bytes) -> None:
        super().__init__(reader)
        self._begun = begun

    async def read(self, n: int = -1) -> bytes:
        if n > MAX_PACKET_BYTES:
            raise MQTTError(f"a packet of {n} bytes; {MAX_PACKET_BYTES} are the most")
        head, self._begun = self._begun[:n], self._begun[n:]
        rest: bytes = await super().read(n - len(head)) if len(head) < n else b""
        return head + rest


async def _greeted(reader: StreamReader, writer: StreamWriter) -> bytes | None:
    """What a client begins with; None: it speaks a version that the library takes for garbage, and was told so."""
    head = await reader.readexactly(2)
    while head[-1] & 0x80 and len(head) < 5:  # a length of several bytes
        head += await reader.readexactly(1)
    head += await reader.readexactly(7)
    if head[0] == _CONNECT and head[-5:-1] == b"MQTT" and head[-1] == 5:
        writer.write(_UNSUPPORTED)
        return None
    return head


class _Writer(StreamWriterAdapter):  # type: ignore[misc]
    """Has nobody wait for a client that reads slowly: what the library sends it would pile up there, as tasks."""

    def __init__(self, writer: StreamWriter, everybody: Collection[StreamWriter]) -> None:
        super().__init__(writer)
        self._own, self._everybody = writer.transport, everybody

    async def drain(self) -> None:
        """Give up a client that has too much to read. ConnectionResetError."""
        if self._is_slow():
            log.warning("client %s:%d reads too slowly: its connection is ended", *self.get_peer_info())
            self._own.abort()
        if self._own.is_closing():
            raise ConnectionResetError

    def _is_slow(self) -> bool:
        unread = self._own.get_write_buffer_size()
        if unread <= UNREAD_BYTES // MAX_CONNECTIONS:  # a fair part
            return False
        all_bytes = sum(one.transport.get_write_buffer_size() for one in self._everybody)
        return unread > MAX_UNREAD_BYTES or all_bytes > UNREAD_BYTES


class _BridgesWriter(_Writer):
    """That of a UNIX socket, whose peers have no address."""

    def get_peer_info(self) -> tuple[str, int]:
        return _BRIDGE, 0


async def serve(worker: Worker, settings: Mqtt, place: Path) -> None:
    """Be the broker until told to stop. EndpointError: the address cannot be listened on; ConfigError."""
    global accounts  # noqa: PLW0603  see there
    accounts = read_accounts(settings.password_file) if settings.password_file else None
    logging.getLogger("amqtt").setLevel(logging.ERROR)
    logging.getLogger("transitions").setLevel(logging.ERROR)
    broker = _Broker(
        {
            "listeners": {_LISTENER: {"type": "external"}},
            "plugins": {f"{__name__}.{Accounts.__name__}": {}},
        }
    )
    await broker.start()
    address = Address.parse(str(settings.listen))
    context = server_context(settings.tls) if settings.tls else None
    connections = _Connections(broker)
    servers: list[asyncio.Server] = []
    try:
        servers.append(await asyncio.start_unix_server(connections.take_bridge, place / SOCKET))
        servers.append(await _listen(connections, address, context))
        worker.running()
        stopping = asyncio.Event()
        loop = asyncio.get_running_loop()
        worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
        while not stopping.is_set():
            worker.report()
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

    def __init__(self, broker: Broker) -> None:
        self._broker = broker
        self._open: set[StreamWriter] = set()

    async def take_bridge(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Of the UNIX socket."""
        await self._serve(reader, writer, _BridgesWriter(writer, self._open))

    async def take(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Of the address."""
        if len(self._open) >= MAX_CONNECTIONS:
            log.warning("a connection is refused: there are %d", len(self._open))
            writer.close()
            return
        self._open.add(writer)
        try:
            await self._serve(reader, writer, _Writer(writer, self._open))
        finally:
            self._open.discard(writer)

    async def _serve(self, reader: StreamReader, writer: StreamWriter, adapter: StreamWriterAdapter) -> None:
        try:
            begun = await asyncio.wait_for(_greeted(reader, writer), GREETING_S)
            if begun is not None:
                await self._broker.external_connected(_Reader(reader, begun), adapter, _LISTENER)
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            pass  # it is gone, or speaks something else
        finally:
            writer.close()
