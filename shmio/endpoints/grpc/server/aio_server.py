"""gRPC's asyncio server, made safe against calls of unknown names.

grpcio's serving task decodes the name of every call that is not registered. A name that is not UTF-8 ends the task, and
its cleanup frees what the core still writes to. All unregistered calls also share one queue. Here every method is
registered: the core matches names by their bytes, and each method has its own queue. A few workers refuse all others.

This needs private names of grpcio. A version without them is refused at start.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, Final

import grpc

from shmio.errors import EndpointError

cygrpc: Any = import_module("grpc._cython.cygrpc")
AioServer: Any = import_module("grpc.aio._server").Server

WORKERS: Final = 8
"""How many calls of unknown names are refused at once."""

_NEEDED: Final[Mapping[str, str]] = {
    "AioServer": "_make_request_call_future _request_call add_registered_method_handlers is_running shutdown",
    "_ServicerContext": "abort",
    "_RequestCallError": "",
    "get_working_loop": "",
}
_NO_CALL: Final = "there is no such call; reflection lists the services"


def check_version() -> None:
    """Check that grpcio has the private names needed here. EndpointError: it lacks some."""
    missing = [
        f"{name}.{member}".rstrip(".")
        for name, members in _NEEDED.items()
        for member in members.split() or [""]
        if not hasattr(getattr(cygrpc, name, None), member or "__name__")
    ]
    if missing:
        raise EndpointError(
            f"grpcio {grpc.__version__} lacks {', '.join(missing)}, without which unknown calls could stop the "
            "endpoint: install another version (tested: 1.84.0 to 1.85.1)"
        )


class Core(getattr(cygrpc, "AioServer", object)):  # type: ignore[misc]
    """A gRPC core whose serving task only gets calls of registered methods."""

    def start_workers(self) -> None:
        """Start the workers that refuse calls of unknown names."""
        self._taking = asyncio.Lock()  # one request for a call at a time is enough, and leaves the rest to the core
        self.refused = 0
        self._workers = [asyncio.create_task(self._refuse()) for _ in range(WORKERS)]

    @property
    def alive(self) -> bool:
        """Whether the core serves. If not, it never will again, and the process has to end."""
        return bool(self.is_running()) and not any(worker.done() for worker in self._workers)

    def _make_request_call_future(self, method: bytes | None) -> asyncio.Future[Any]:
        if method is None:
            return asyncio.get_running_loop().create_future()  # never done: the workers take these
        return _kept(super()._make_request_call_future(method))

    async def _refuse(self) -> None:
        while self.is_running():
            async with self._taking:
                if not self.is_running():
                    return
                try:
                    state = await _kept(asyncio.create_task(self._request_call()))
                except cygrpc._RequestCallError:  # it is shutting down
                    continue
            self.refused += 1
            context = cygrpc._ServicerContext(state, None, None, asyncio.get_running_loop())
            try:
                await context.abort(grpc.StatusCode.UNIMPLEMENTED, _NO_CALL)
            except (grpc.aio.AbortError, grpc.aio.InternalError):  # sent, or the client is gone
                pass
            finally:
                del state, context  # which hold the call


class CoreServer(AioServer):  # type: ignore[misc]
    """An asyncio gRPC server with such a core."""

    def __init__(self, options: Sequence[tuple[str, Any]], interceptor: grpc.aio.ServerInterceptor) -> None:
        """Create a server with one interceptor and without grpc.aio.server()'s other arguments."""
        check_version()
        self._loop = cygrpc.get_working_loop()
        self._server: Core = Core(self._loop, None, (), (interceptor,), tuple(options), None)

    @property
    def alive(self) -> bool:
        """Whether the server serves."""
        return bool(self._server.alive)

    @property
    def refused(self) -> int:
        """Number of calls of unknown names since the start."""
        return int(self._server.refused)

    async def start(self) -> None:
        """Start serving."""
        await super().start()
        self._server.start_workers()


def _kept(request: asyncio.Task[Any]) -> asyncio.Future[Any]:
    """Shield a request for a call from cancellation, because the core writes to its memory."""
    request.add_done_callback(lambda done: done.cancelled() or done.exception())  # no one else may retrieve the error
    return asyncio.shield(request)
