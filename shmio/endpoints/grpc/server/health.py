"""Health (``grpc.health.v1``) of the endpoint, its services and its sources; for the event loop's thread.

grpcio-health-checking has a servicer, too: it tells watchers under the lock that a change of what they watch needs, and
so one that does not read stops all news of that service, and the end of the process.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import grpc
from grpc_health.v1 import health_pb2 as wire
from grpc_health.v1 import health_pb2_grpc

from shmio.layout.topic import shorten

Context = grpc.aio.ServicerContext[Any, Any]


class Health(health_pb2_grpc.HealthServicer):
    """Tells each watcher the newest status, however slowly it reads."""

    def __init__(self) -> None:
        self._serving: dict[str, bool] = {}
        self._watchers: dict[str, set[asyncio.Event]] = {}
        self._over = False

    def set(self, service: str, *, serving: bool) -> None:
        """Show it; nothing changes any more once it is over."""
        if not self._over:
            self._serving[service] = serving
            for changed in self._watchers.get(service, ()):
                changed.set()

    def end(self) -> None:
        """Show that nothing is served from now on."""
        for service in list(self._serving):
            self.set(service, serving=False)
        self._over = True

    async def Check(self, request: wire.HealthCheckRequest, context: Context) -> wire.HealthCheckResponse:  # noqa: N802  the name of the call
        """The status of a service; NOT_FOUND."""
        if request.service not in self._serving:
            await context.abort(grpc.StatusCode.NOT_FOUND, f"{shorten(request.service)!r}: no such service")
        return self._status(request.service)

    async def Watch(self, request: wire.HealthCheckRequest, _: Context) -> AsyncIterator[wire.HealthCheckResponse]:  # noqa: N802
        """Stream the status of a service, which may be unknown, and each change that is not over before it is read."""
        changed = asyncio.Event()
        watchers = self._watchers.setdefault(request.service, set())
        watchers.add(changed)
        told = None
        try:
            while True:
                changed.clear()
                status = self._status(request.service)
                if status != told:
                    told = status
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
