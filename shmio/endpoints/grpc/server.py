"""The server: listening addresses, TLS, limits, health and reflection."""

from __future__ import annotations

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from shmio.config import Address, Tls
from shmio.config.tls import read_tls
from shmio.endpoints.grpc.services import Services
from shmio.errors import EndpointError

MAX_REQUEST_BYTES = 1 << 20
MAX_CALLS = 4096

_SERVING = health_pb2.HealthCheckResponse.SERVING
_NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING
_OPTIONS = [
    ("grpc.so_reuseport", 0),  # else a second server would take the same port in silence
    ("grpc.max_receive_message_length", MAX_REQUEST_BYTES),
    # A client whose host vanished is noticed within half a minute.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.http2.min_recv_ping_interval_without_data_ms", 5_000),
]


class Server:
    """All services on each of the addresses."""

    def __init__(self, services: Services) -> None:
        self._health = health.aio.HealthServicer()
        self._server = grpc.aio.server(options=_OPTIONS, maximum_concurrent_rpcs=MAX_CALLS)
        self._server.add_generic_rpc_handlers(services.handlers())
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        self._names = services.names
        names = [*self._names, health.SERVICE_NAME, reflection.SERVICE_NAME]
        reflection.enable_server_reflection(names, self._server)

    async def start(self, addresses: list[Address], tls: Tls | None) -> list[int]:
        """Listen on all addresses; the ports, for those that were 0.

        ConfigError: a file of ``tls`` cannot be used. EndpointError names the address in the way.
        """
        credentials = _credentials(tls) if tls else None
        ports = []
        for address in addresses:
            try:
                if credentials:
                    ports.append(self._server.add_secure_port(str(address), credentials))
                else:
                    ports.append(self._server.add_insecure_port(str(address)))
            except RuntimeError:
                raise EndpointError(
                    f"grpc.listen: cannot listen on {address}: another program has it (ss -ltnp shows which), or this "
                    "host has no such address"
                ) from None
        await self._server.start()
        for service in (health.OVERALL_HEALTH, *self._names):
            await self._health.set(service, _SERVING)
        return ports

    async def set_source(self, source: str, good: bool) -> None:
        """Show a source's quality as the health of ``source.<name>``."""
        await self._health.set(f"source.{source}", _SERVING if good else _NOT_SERVING)

    async def stop(self) -> None:
        """Say so, end all streams, close."""
        await self._health.enter_graceful_shutdown()
        await self._server.stop(grace=0.2)


def _credentials(tls: Tls) -> grpc.ServerCredentials:
    files = read_tls(tls)
    return grpc.ssl_server_credentials(
        [(files.key, files.certificate)],
        root_certificates=files.client_ca,
        require_client_auth=files.client_ca is not None,
    )
