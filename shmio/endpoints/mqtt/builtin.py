"""aMQTT as our own broker, where there is no mosquitto: pure Python, in this process, MQTT 3.1.1."""

from __future__ import annotations

import asyncio
import logging
import ssl
from asyncio import StreamReader, StreamWriter
from collections.abc import Collection
from pathlib import Path
from typing import Any, Final

from amqtt.adapters import StreamReaderAdapter, StreamWriterAdapter
from amqtt.broker import Broker
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
UNHANDLED_BYTES: Final = 256 << 10
"""Of one client's messages that were read, and not handed on: then no more is read of it."""
MAX_UNHANDLED: Final = 64
"""Messages of all that are being handed on."""
MAX_KEPT: Final = 1000
"""Messages for one client's session while it is away; as mosquitto, it is given the oldest."""
MESSAGE_BYTES: Final = 1000
"""Of one in memory, about, beside its payload."""
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


class _Unhandled(asyncio.Queue[Any]):
    """What was read of a client. Its bound is kept by who reads: a full one would drop what has QoS 0."""

    def _init(self, maxsize: int) -> None:
        super()._init(maxsize)
        self._bytes = 0
        self._room = asyncio.Event()
        self._room.set()

    def _put(self, item: Any) -> None:
        super()._put(item)
        self._count(MESSAGE_BYTES + len(item.data))

    def _get(self) -> Any:
        item = super()._get()
        self._count(-MESSAGE_BYTES - len(item.data))
        return item

    def _count(self, size: int) -> None:
        self._bytes += size
        (self._room.set if self._bytes < UNHANDLED_BYTES else self._room.clear)()

    async def room(self) -> None:
        """Wait until there is some."""
        await self._room.wait()


class _Broker(Broker):  # type: ignore[misc]
    """Sends a client what is retained for its own subscriptions alone; aMQTT sends who connects that of everybody's.

    What it has read and not handed on is bounded: who publishes faster than that goes is slowed down by TCP.
    """

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__(config)
        self._broadcast_queue: asyncio.Queue[Any] = asyncio.Queue(MAX_UNHANDLED)

    async def _handle_client_session(
        self, reader: _Reader, writer: _Writer, client_session: Session, *rest: Any
    ) -> None:
        if not isinstance(client_session.delivered_message_queue, _Unhandled):  # else it is one from before
            client_session.delivered_message_queue = _Unhandled()
        reader.unhandled = client_session.delivered_message_queue
        await super()._handle_client_session(reader, writer, client_session, *rest)

    async def _retain_broadcast_message(self, broadcast: dict[str, Any], qos: int, target_session: Session) -> None:
        if target_session.retained_messages.qsize() < MAX_KEPT:
            await super()._retain_broadcast_message(broadcast, qos, target_session)

    async def _publish_retained_messages_for_subscription(
        self, subscription: tuple[str, int], session: Session
    ) -> None:
        if any(whose.client_id == session.client_id for whose, _ in self._subscriptions.get(subscription[0], ())):
            await super()._publish_retained_messages_for_subscription(subscription, session)


class _Reader(StreamReaderAdapter):  # type: ignore[misc]
    """Takes no packet that is too large, nor any while too much waits. ``begun``: what was read before."""

    def __init__(self, reader: StreamReader, begun: bytes) -> None:
        super().__init__(reader)
        self._begun = begun
        self.unhandled: _Unhandled | None = None
        """What was read of this client, as soon as it is known."""

    async def read(self, n: int = -1) -> bytes:
        if n > MAX_PACKET_BYTES:
            # With one of its own errors the library would go on, and take what is in the packet for packets.
            log.warning("a packet of %d bytes; %d are the most: its connection is ended", n, MAX_PACKET_BYTES)
            raise OSError("too large a packet")
        if n > 1 and self.unhandled is not None:  # not at a packet's beginning, which has to come within the keep-alive
            await self.unhandled.room()
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
