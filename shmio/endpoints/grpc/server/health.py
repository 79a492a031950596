"""Serves the health (``grpc.health.v1``) of the endpoint, its services and its sources.

The servicer of grpcio-health-checking is not suitable: while it sends a status to a watcher, it
holds a lock that each change of a status needs. A watcher that does not read would therefore block
all changes of that service, and also the end of the process.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import grpc
from grpc_health.v1 import health_pb2 as wire
from grpc_health.v1 import health_pb2_grpc

from shmio.endpoints.grpc.server.error_status import Context
from shmio.layout.topic import shorten


class Health(health_pb2_grpc.HealthServicer):
    """Serves the health of services. A slow watcher gets only the newest status.

    Use it only in the event loop's thread.
    """

    def __init__(self) -> None:
        self._serving: dict[str, bool] = {}
        self._watchers: dict[str, set[asyncio.Event]] = {}
        self._over = False

    def set(self, service: str, *, serving: bool) -> None:
        """Set the status of a service. After :meth:`end`, this has no effect."""
        if not self._over:
            self._serving[service] = serving
            for changed in self._watchers.get(service, ()):
                changed.set()

    def end(self) -> None:
        """Set all services to not serving. This cannot be undone."""
        for service in list(self._serving):
            self.set(service, serving=False)
        self._over = True

    async def Check(self, request: wire.HealthCheckRequest, context: Context) -> wire.HealthCheckResponse:  # noqa: N802  the name of the call
        """Return the status of a service.

        Statuses:
            NOT_FOUND: There is no such service.
        """
        if request.service not in self._serving:
            await context.abort(grpc.StatusCode.NOT_FOUND, f"{shorten(request.service)!r}: no such service")
        return self._status(request.service)

    async def Watch(self, request: wire.HealthCheckRequest, _: Context) -> AsyncIterator[wire.HealthCheckResponse]:  # noqa: N802
        """Stream the status of a service and its changes.

        A slow client gets only the newest status. The service need not exist yet.
        """
        changed = asyncio.Event()
        watchers = self._watchers.setdefault(request.service, set())
        watchers.add(changed)
        sent = None
        try:
            while True:
                changed.clear()
                status = self._status(request.service)
                if status != sent:
                    sent = status
                    yield status
                await changed.wait()
        finally:
            watchers.discard(changed)
            if not watchers and self._watchers.get(request.service) is watchers:
                del self._watchers[request.service]

    def _status(self, service: str) -> wire.HealthCheckResponse:
        if service not in self._serving:
            return wire.HealthCheckResponse(status=wire.HealthCheckResponse.SERVICE_UNKNOWN)
        shown = wire.HealthCheckResponse.SERVING if self._serving[service] else wire.HealthCheckResponse.NOT_SERVING
        return wire.HealthCheckResponse(status=shown)
