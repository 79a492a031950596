"""The connections of our own broker in Python, as the library reads and writes them; hostile clients are given up."""

from __future__ import annotations

import asyncio
from asyncio import StreamReader, StreamWriter
from collections.abc import Awaitable, Callable, Collection
from typing import Final, NoReturn

from amqtt.adapters import StreamReaderAdapter, StreamWriterAdapter

from shmio.endpoints.mqtt.broker.access import Guest
from shmio.endpoints.mqtt.broker.amqtt_shares import Bound, Refusals
from shmio.endpoints.mqtt.broker.mosquitto import MAX_PACKET_BYTES

PEER: Final = "bridge"
"""The address of the UNIX socket's clients, which have none."""
UNREAD: Final = Bound(8 << 20, 64 << 20)
"""That may wait for clients; for one it is several packets of the largest kind."""
MAX_CONNECT_BYTES: Final = 5 * (2 + 65535) + 16
"""Of a CONNECT: five fields (MQTT 3.1.1, section 3.1.3)."""
MAX_FIELDS: Final = 4096
"""Of one packet: each topic that is subscribed to has three."""
TOO_LARGE: Final = "client %s: a packet is too large, or of too many topics: its connection is ended; send smaller ones"
TOO_SLOW: Final = "client %s reads too slowly: its connection is ended; have it subscribe to less"
NO_TOPIC: Final = "client %s publishes on what is no topic: its connection is ended"
_CONNECT: Final = 0x10
_PUBLISH: Final = 0x30
_UNSUPPORTED: Final = b"\x20\x03\x00\x84\x00"
"""MQTT 5.0, section 3.2: a CONNACK that refuses the protocol's version."""


class Reader(StreamReaderAdapter):  # type: ignore[misc]  # the library's classes have no types
    """Takes no packet that is too large, nor any while too much waits."""

    def __init__(self, reader: StreamReader, begun: bytes, client: str, refusals: Refusals, guest: Guest) -> None:
        """``begun``: what was read before; ``client``: its address."""
        super().__init__(reader)
        self.guest = guest
        self.client = client
        """Its name, for people."""
        self.on_packet: Callable[[], object] = lambda: None
        """Called for each."""
        self.admit: Callable[[], Awaitable[object]] | None = None
        """Waited for before more of a packet is read than its head, which has to come within the keep-alive."""
        self._begun, self._refusals = begun, refusals
        self._head = b""
        self._publishing = False
        self._left = self._fields = 0  # of the packet that is being read: bytes to come, fields that have

    async def read(self, n: int = -1) -> bytes:
        """So many bytes of the packet that is read, or of the head of the next one. OSError: it is too large."""
        if not self._left:
            data = await self._take(n)
            self._begin(data)
            await asyncio.sleep(0)  # for the tasks of those before: else they pile up, as long as there is more to read
            return data
        self._fields += 1
        if n > self._left or self._fields > MAX_FIELDS:
            self.end(TOO_LARGE)
        if self.admit is not None:
            await self.admit()
        data = await self._take(n)
        self._left -= n
        if self._publishing and not _begins_topic(self._fields, data):
            self.end(NO_TOPIC)  # the library would take what follows for another packet, and wait for its rest
        return data

    async def _take(self, n: int) -> bytes:
        head, self._begun = self._begun[:n], self._begun[n:]
        rest: bytes = await super().read(n - len(head)) if len(head) < n else b""
        return head + rest

    def _begin(self, data: bytes) -> None:
        """Of a head: its kind, and then its length, seven bits a byte (MQTT 3.1.1, section 2.2.3)."""
        self._head += data
        _, *length = self._head or b"\0"
        if not length or (length[-1] & 0x80 and len(length) < 4):
            return
        self._left = sum((byte & 0x7F) << 7 * place for place, byte in enumerate(length))
        self._publishing = self._head[0] & 0xF0 == _PUBLISH
        self._head, self._fields = b"", 0
        if self._left > MAX_PACKET_BYTES or length[-1] & 0x80:
            self.end(TOO_LARGE)
        self.on_packet()

    def end(self, why: str) -> NoReturn:
        """Give it up. OSError: with one of its own errors the library would go on, and take its data for packets."""
        self._refusals.tell(why, self.client)
        raise OSError(why)


def _begins_topic(field: int, data: bytes) -> bool:
    """Whether a field of a PUBLISH may be so: the first is the topic's length, the second the topic (3.1.1, 3.3.2)."""
    if field > 2:
        return True
    try:
        return any(data) if field == 1 else not set("+#\0").intersection(data.decode())
    except UnicodeDecodeError:
        return False


async def greeted(reader: StreamReader, writer: StreamWriter) -> bytes | None:
    """A client's CONNECT; None: it speaks a version that the library takes for garbage, and was told so.

    OSError: it is too large. What is no CONNECT is returned as it begins: the library refuses it.
    """
    head = await reader.readexactly(2)
    while head[-1] & 0x80 and len(head) < 5:  # a length of several bytes
        head += await reader.readexactly(1)
    left = sum((byte & 0x7F) << 7 * place for place, byte in enumerate(head[1:])) - 7
    head += await reader.readexactly(7)
    if head[0] != _CONNECT or left < 0:
        return head
    if head[-5:-1] == b"MQTT" and head[-1] == 5:
        writer.write(_UNSUPPORTED)
        return None
    if left > MAX_CONNECT_BYTES:
        raise OSError("too large a CONNECT")
    return head + await reader.readexactly(left)


class Writer(StreamWriterAdapter):  # type: ignore[misc]
    """Has nobody wait for a client that reads slowly: what the library sends it would pile up there, as tasks."""

    def __init__(
        self, writer: StreamWriter, everybody: Collection[StreamWriter], client: str, refusals: Refusals
    ) -> None:
        super().__init__(writer)
        self._own, self._everybody = writer.transport, everybody
        self.client = client
        """Its name, for people."""
        self._refusals = refusals

    async def drain(self) -> None:
        """Give up a client that has too much to read. ConnectionResetError."""
        if UNREAD.broken(self._own.get_write_buffer_size(), self._unread) and not self._own.is_closing():
            self._refusals.tell(TOO_SLOW, self.client)
            self._own.abort()
        if self._own.is_closing():
            raise ConnectionResetError

    def _unread(self) -> list[int]:
        return [one.transport.get_write_buffer_size() for one in self._everybody]


class BridgesWriter(Writer):
    """That of a UNIX socket, whose peers have no address."""

    def get_peer_info(self) -> tuple[str, int]:
        """What the library takes for its address."""
        return PEER, 0
