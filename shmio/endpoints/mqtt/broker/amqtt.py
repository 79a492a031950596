"""Runs aMQTT as the instance's own broker, for development on a host without mosquitto.

The broker speaks MQTT 3.1.1. Every program that can reach it may publish and subscribe to
everything. Roles cannot be enforced: aMQTT publishes wills without asking its plugins, and replaces
a client's session before it authenticates the new client.
"""

from __future__ import annotations

import asyncio
import logging
from asyncio import IncompleteReadError, StreamReader, StreamWriter
from pathlib import Path
from typing import Final

from amqtt.adapters import StreamReaderAdapter, StreamWriterAdapter
from amqtt.broker import Broker

from shmio.config import Address, Mqtt
from shmio.endpoints.mqtt.broker.directory import SOCKET, new_secret
from shmio.errors import EndpointError
from shmio.wording import cannot_listen
from shmio.worker import BEAT_S, Worker

GREETING_S: Final = 10.0
_LISTENER: Final = "default"
_CONFIG: Final = {
    "listeners": {_LISTENER: {"type": "external"}},  # we accept the connections, because one socket is a UNIX socket
    "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {}},
}
_UNSUPPORTED: Final = b"\x20\x03\x00\x84\x00"
"""A CONNACK packet that refuses the client's version of the protocol (MQTT 5.0, section 3.2)."""

log = logging.getLogger("shmio.mqtt")


async def serve(worker: Worker, settings: Mqtt, place: Path) -> None:
    """Run the broker until the worker is stopped.

    Raises:
        EndpointError: The broker cannot listen on the address.

    """
    for library in ("amqtt", "transitions"):
        logging.getLogger(library).setLevel(logging.ERROR)
    broker = Broker(_CONFIG)
    await broker.start()
    new_secret(place)  # the bridge's client ids contain it, so that others cannot guess them and take them over
    servers: list[asyncio.Server] = []

    async def take(reader: StreamReader, writer: StreamWriter) -> None:
        await _serve(broker, reader, writer)

    try:
        servers.append(await asyncio.start_unix_server(take, place / SOCKET))
        address = Address.parse(str(settings.listen))
        try:
            servers.append(await asyncio.start_server(take, address.host, address.port))
        except OSError as error:
            raise EndpointError(cannot_listen(address, error)) from None
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


async def _serve(broker: Broker, reader: StreamReader, writer: StreamWriter) -> None:
    """Serve one client's connection until it ends."""
    try:
        begun = await asyncio.wait_for(_until_version(reader), GREETING_S)
        if begun.endswith(b"MQTT\5"):
            writer.write(_UNSUPPORTED)  # aMQTT would parse the packet as version 3.1.1, and wait for more bytes
        else:
            await broker.external_connected(_Reader(reader, begun), _Writer(writer), _LISTENER)
    except (OSError, TimeoutError, IncompleteReadError):
        pass  # the client is gone, or speaks another protocol
    except Exception as error:  # noqa: BLE001  such as "dictionary changed size" when others subscribe concurrently
        log.warning("aMQTT ended a connection because of %r; the client has to connect again", error)
    finally:
        writer.close()


async def _until_version(reader: StreamReader) -> bytes:
    """Read the start of a CONNECT packet, up to the version of the protocol."""
    head = await reader.readexactly(2)
    while head[-1] & 0x80 and len(head) < 5:  # the packet's length has one to four bytes
        head += await reader.readexactly(1)
    return head + await reader.readexactly(7)


class _Reader(StreamReaderAdapter):  # type: ignore[misc]  # the library's classes have no types
    """Reader that first returns bytes that were read before, and then reads the connection."""

    def __init__(self, reader: StreamReader, begun: bytes) -> None:
        super().__init__(reader)
        self._begun = begun

    async def read(self, n: int = -1) -> bytes:
        """Read ``n`` bytes."""
        head, self._begun = self._begun[:n], self._begun[n:]
        rest: bytes = await super().read(n - len(head)) if len(head) < n else b""
        return head + rest


class _Writer(StreamWriterAdapter):  # type: ignore[misc]
    """Gives each client of the UNIX socket an address, because aMQTT demands one."""

    def get_peer_info(self) -> tuple[str, int]:
        """Return the host and port of the client."""
        return super().get_peer_info() or ("bridge", 0)
