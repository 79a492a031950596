"""The server: listening addresses, TLS, limits, health and reflection."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from typing import Any, Final
from urllib.parse import quote

import grpc
from grpc_health.v1 import health, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from shmio.config import Address, Tls, UnixAddress
from shmio.config.tls import read_tls
from shmio.config.unix_socket import SocketFile, clear
from shmio.endpoints.grpc.server.access import Listener
from shmio.endpoints.grpc.server.call_guard import CallGuard, CoreServer, OpenCalls
from shmio.endpoints.grpc.server.health import Health
from shmio.endpoints.grpc.server.limits import room, shortage
from shmio.errors import EndpointError
from shmio.wording import IN_USE

MAX_REQUEST_BYTES = 1 << 20
GRACE_S: Final = 0.2
"""Time in s that open calls have to end by themselves when the endpoint stops."""
STOP_S: Final = 2.5
"""Maximum duration of a stop, in s. If a stop takes longer, the supervisor kills the process."""

log = logging.getLogger("shmio.grpc")

OPTIONS = [
    ("grpc.so_reuseport", 0),  # otherwise a second server could silently use the same port
    ("grpc.max_receive_message_length", MAX_REQUEST_BYTES),
    # Do not cancel a call that has waited long in the queue: its client sets the deadline.
    ("grpc.server_max_unrequested_time_in_server", 3600),
    # Notice within half a minute that a client's host has vanished.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.http2.min_ping_interval_without_data_ms", 5_000),
]


class Server:
    """Serves all services at each listening address. A :class:`CallGuard` checks the calls."""

    def __init__(
        self, services: Mapping[str, dict[str, grpc.RpcMethodHandler[Any, Any]]], calls: OpenCalls | None = None
    ) -> None:
        """Create the server; :meth:`start` starts it.

        Args:
            services: The handlers of each service, by the service's full name.
            calls: Counts and limits the open calls; None for a new :class:`OpenCalls`.

        """
        self.calls = OpenCalls() if calls is None else calls
        """The open calls on all addresses."""
        self._services = services
        self._health = Health()
        self._servers: list[CoreServer] = []
        self._files: dict[str, SocketFile] = {}
        self._connections = 1
        self.shortage = ""
        """Note for ``shmio-supervisor status`` if the endpoint can serve too few connections; otherwise empty."""
        logging.getLogger("grpc._cython.cygrpc").addFilter(_is_news)

    @property
    def alive(self) -> bool:
        """True if all addresses are served.

        If not, the process must end, because a second server in the same process would corrupt its
        memory.
        """
        return all(server.alive for server in self._servers)

    @property
    def unknown(self) -> int:
        """Number of calls with unknown names since the start. All of them were refused."""
        return sum(server.refused for server in self._servers)

    async def start(self, listeners: Sequence[Listener], tls: Tls | None = None, gid: int | None = None) -> list[int]:
        """Listen on all addresses, and return their ports.

        Args:
            listeners: The addresses; port 0 stands for any free port.
            tls: Certificate and key for encrypted addresses; None if no address is encrypted.
            gid: A group whose members may also open UNIX sockets; None for no group.

        Raises:
            ConfigError: A file of ``tls`` cannot be used.
            EndpointError: An address cannot be used; the message names it.

        """
        credentials = _credentials(tls) if tls else None
        wanted = self.calls.limits.connections
        connections = room(wanted)
        if connections < wanted:
            log.warning(
                "the endpoint serves at most %d connections, not %d: the hard limit of open files is too low",
                connections,
                wanted,
            )
        self.shortage = shortage(connections, wanted)
        self._connections = max(1, connections // len(listeners))
        ports = []
        for listener in listeners:
            server = self._server(CallGuard(listener.access, self.calls))
            ports.append(self._bind(server, listener, credentials, gid))
            self._servers.append(server)
        for server in self._servers:
            await server.start()
        for service in (health.OVERALL_HEALTH, *self._services):
            self._health.set(service, serving=True)
        return ports

    async def set_source(self, source: str, good: bool) -> None:
        """Set the health of ``source.<name>``: it is serving while the source's quality is good."""
        self._health.set(f"source.{source}", serving=good)

    async def stop(self) -> None:
        """Set the health of all services to not serving, end all calls, and close. This takes at most ``STOP_S``."""
        self._health.end()
        ends = [asyncio.create_task(server.stop(GRACE_S)) for server in self._servers]
        if ends and (await asyncio.wait(ends, timeout=STOP_S))[1]:
            log.warning("some calls did not end within %g s; they will end with the process", STOP_S)
        for file in self._files.values():
            file.remove()

    def _bind(
        self, server: CoreServer, listener: Listener, credentials: grpc.ServerCredentials | None, gid: int | None
    ) -> int:
        address = listener.address
        if isinstance(address, UnixAddress):
            clear(address.path)  # gRPC itself would take the path from a running process
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
            raise EndpointError(f"grpc: cannot listen on {address}: {IN_USE}") from None
        return int(port)

    def _server(self, gate: CallGuard) -> CoreServer:
        # One connection may have as many streams as there may be calls in total. By default, gRPC
        # ends some calls at random when 1000 wait, and a client that opens thousands at once would
        # lose some. Each method has its own queue, and so have the calls with unknown names.
        most = self.calls.limits.calls
        pending = "grpc.server.max_pending_requests"
        options: list[tuple[str, Any]] = [
            *OPTIONS,
            ("grpc.max_concurrent_streams", most),
            ("grpc.max_allowed_incoming_connections", self._connections),
            (pending, most),
            (f"{pending}_hard_limit", most + most // 4),
        ]
        server = CoreServer(options, gate)
        for name, calls in self._services.items():
            server.add_registered_method_handlers(name, calls)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, server)
        names = [*self._services, health.SERVICE_NAME, reflection.SERVICE_NAME]
        reflection.enable_server_reflection(names, server)
        return server


def _credentials(tls: Tls) -> grpc.ServerCredentials:
    files = read_tls(tls)
    return grpc.ssl_server_credentials(
        [(files.key, files.certificate)],
        root_certificates=files.client_ca,
        require_client_auth=files.client_ca is not None,
    )


def _is_news(record: logging.LogRecord) -> bool:
    """Return False for gRPC's tracebacks about headers that are not UTF-8.

    Any client can cause such tracebacks.
    """
    return not str(record.msg).startswith("Invalid encoding on ")
