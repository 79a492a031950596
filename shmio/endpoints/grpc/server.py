"""The server: listening addresses, TLS, limits, health and reflection."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final
from urllib.parse import quote

import grpc
from grpc_health.v1 import health, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from shmio.config import Address, Tls, UnixAddress
from shmio.config.tls import read_tls
from shmio.config.unixsocket import SocketFile, clear, listened_on
from shmio.endpoints.grpc.descriptors import room
from shmio.endpoints.grpc.doors import Listener
from shmio.endpoints.grpc.gate import Calls, Gate
from shmio.endpoints.grpc.health import Health
from shmio.endpoints.grpc.services import Services
from shmio.errors import EndpointError

MAX_REQUEST_BYTES = 1 << 20
LOOK_S: Final = 0.2
"""Time between two looks whether gRPC still serves."""
CLOSES_S: Final = 0.02
"""Time between two looks whether a listener has closed."""
FREE_S: Final = 10.0

log = logging.getLogger("shmio.grpc")

OPTIONS = [
    ("grpc.so_reuseport", 0),  # else a second server would take the same port in silence
    ("grpc.max_receive_message_length", MAX_REQUEST_BYTES),
    # A client whose host vanished is noticed within half a minute.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.http2.min_ping_interval_without_data_ms", 5_000),
]


class Server:
    """All services on each of the addresses, each behind a gate."""

    def __init__(self, services: Services, calls: Calls | None = None) -> None:
        self.calls = Calls() if calls is None else calls
        """Those that are open, on all addresses."""
        self._services = services
        self._health = Health()
        self._servers: dict[grpc.aio.Server, None] = {}
        self._files: dict[str, SocketFile] = {}
        self._keepers: list[asyncio.Task[None]] = []
        self._retiring: set[asyncio.Task[None]] = set()
        self._connections = 1
        """How many each address may have."""
        logging.getLogger("grpc._cython.cygrpc").addFilter(_is_news)

    @property
    def alive(self) -> bool:
        """Whether it listens on all addresses, or is about to again."""
        return not any(keeper.done() for keeper in self._keepers)

    async def start(self, listeners: Sequence[Listener], tls: Tls | None = None, gid: int | None = None) -> list[int]:
        """Listen on all addresses; the ports, for those that were 0.

        ``gid``: the group that may open UNIX sockets, too. ConfigError: a file of ``tls`` cannot be used.
        EndpointError names the address in the way.
        """
        credentials = _credentials(tls) if tls else None
        wanted = self.calls.limits.connections
        connections = room(wanted)
        if connections < wanted:
            log.warning("at most %d connections, not %d: the hard limit of open files is too low", connections, wanted)
        self._connections = max(1, connections // len(listeners))
        ports = []
        for listener in listeners:
            server = self._server(Gate(listener.door, self.calls))
            self._servers[server] = None
            ports.append(self._bind(server, listener, credentials, gid))
        for server, listener, port in zip(list(self._servers), listeners, ports, strict=True):
            await server.start()
            host = listener.address
            same = listener._replace(address=Address(host.host, port)) if isinstance(host, Address) else listener
            self._keepers.append(asyncio.create_task(self._keep(server, same, credentials, gid)))
        for service in (health.OVERALL_HEALTH, *self._services.names):
            self._health.set(service, serving=True)
        return ports

    async def set_source(self, source: str, good: bool) -> None:
        """Show a source's quality as the health of ``source.<name>``."""
        self._health.set(f"source.{source}", serving=good)

    async def stop(self) -> None:
        """Say so, end all streams, close."""
        for keeper in self._keepers:
            keeper.cancel()
        await asyncio.gather(*self._keepers, return_exceptions=True)
        self._health.end()
        await asyncio.gather(*(server.stop(grace=0.2) for server in self._servers), *self._retiring)
        for file in self._files.values():
            file.remove()

    async def _keep(
        self, server: grpc.aio.Server, listener: Listener, credentials: grpc.ServerCredentials | None, gid: int | None
    ) -> None:
        """Listen anew whenever gRPC stops by itself; calls that are open go on. EndpointError: it cannot.

        It does for all clients when one sends the name of a call that is not UTF-8.
        """
        while True:
            try:
                await server.wait_for_termination(LOOK_S)
            except Exception as error:  # noqa: BLE001  whatever has ended its loop
                log.warning("%s: gRPC stopped serving (%s) and listens anew", listener.address, error)
                task = asyncio.create_task(self._retire(server))
                self._retiring.add(task)
                task.add_done_callback(self._retiring.discard)
                await self._free(listener.address)
                server = self._server(Gate(listener.door, self.calls))
                self._servers[server] = None
                self._bind(server, listener, credentials, gid)
                await server.start()

    async def _free(self, address: Address | UnixAddress) -> None:
        """Wait until the one before has closed: gRPC does not survive to find the address taken (segmentation fault).

        EndpointError: it is still taken after ``FREE_S``.
        """
        loop = asyncio.get_running_loop()
        until_s = loop.time() + FREE_S
        while taken(address):
            if loop.time() > until_s:
                raise EndpointError(f"grpc: cannot listen on {address} anew: it is still taken after {FREE_S:g} s")
            await asyncio.sleep(CLOSES_S)

    async def _retire(self, server: grpc.aio.Server) -> None:
        """Let the calls of one that listens no more end by themselves. Not to be cancelled: gRPC would take it ill."""
        with suppress(Exception):  # why it listens no more
            await server.wait_for_termination()
        await server.stop(None)
        del self._servers[server]

    def _bind(
        self, server: grpc.aio.Server, listener: Listener, credentials: grpc.ServerCredentials | None, gid: int | None
    ) -> int:
        address = listener.address
        if isinstance(address, UnixAddress):
            clear(address.path)  # gRPC itself would take it from a living process
        try:
            if isinstance(address, Address):
                if credentials and listener.encrypted:
                    port = server.add_secure_port(str(address), credentials)
                else:
                    port = server.add_insecure_port(str(address))
            else:
                self._files[address.path] = file = SocketFile(address.path, gid)
                with file.binding() as place:
                    port = server.add_insecure_port(f"unix:{quote(place)}")
        except RuntimeError:
            raise EndpointError(
                f"grpc: cannot listen on {address}: another program has it (ss -ltnp shows which), or this host has no "
                "such address"
            ) from None
        return port

    def _server(self, gate: Gate) -> grpc.aio.Server:
        # No connection is told to have room for more than all calls. When 1000 wait to be looked at, gRPC breaks off
        # some at random: clients that begin with thousands of subscriptions at once would lose some.
        most = self.calls.limits.calls
        pending = "grpc.server.max_pending_requests"
        options: list[tuple[str, Any]] = [
            *OPTIONS,
            ("grpc.max_concurrent_streams", most),
            ("grpc.max_allowed_incoming_connections", self._connections),
            (pending, 4 * most),
            (f"{pending}_hard_limit", 8 * most),
        ]
        server = grpc.aio.server(options=options, interceptors=(gate,))
        server.add_generic_rpc_handlers(self._services.handlers())
        health_pb2_grpc.add_HealthServicer_to_server(self._health, server)
        names = [*self._services.names, health.SERVICE_NAME, reflection.SERVICE_NAME]
        reflection.enable_server_reflection(names, server)
        return server


def taken(address: Address | UnixAddress) -> bool:
    """Whether somebody listens there, so that nobody else can."""
    if isinstance(address, UnixAddress):
        return listened_on(address.path)
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address.host, address.port))
            return False
        except OSError as error:
            return error.errno == errno.EADDRINUSE


def _credentials(tls: Tls) -> grpc.ServerCredentials:
    files = read_tls(tls)
    return grpc.ssl_server_credentials(
        [(files.key, files.certificate)],
        root_certificates=files.client_ca,
        require_client_auth=files.client_ca is not None,
    )


def _is_news(record: logging.LogRecord) -> bool:
    """What gRPC says, with a traceback, of headers that are not UTF-8 is none: any client may send them."""
    return not (isinstance(record.msg, UnicodeDecodeError) or str(record.msg).startswith("Invalid encoding on "))
