"""An endpoint that accepts calls but never answers: every call times out."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
import pytest

from shmio.client import calls
from shmio.errors import RemoteError
from tests.unit.client.both import BOTH, Connect


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    over = threading.Event()

    def wait(_requests: Any, _context: grpc.ServicerContext) -> Iterator[bytes]:
        over.wait()
        yield from ()

    class Silent(grpc.GenericRpcHandler):
        def service(self, _: Any) -> Any:
            return grpc.stream_stream_rpc_method_handler(wait)

    monkeypatch.setattr(calls, "WRITE_PATIENCE_S", 0.1)
    server = grpc.server(ThreadPoolExecutor(4), [Silent()])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}"
    over.set()
    server.stop(None).wait()


@BOTH
@pytest.mark.parametrize(
    "ask",
    [
        lambda client: client.layouts(),
        lambda client: client.read("cell/a"),
        lambda client: client.inject("cell/a"),
        lambda client: client.declare([]),
    ],
    ids=["layouts", "read", "inject", "declare"],
)
def test_unanswered_call_times_out(silent: str, connects: Connect, ask: Callable[[Any], Awaitable[object]]) -> None:
    async def test() -> None:
        async with connects(silent, timeout_s=0.1) as client:
            with pytest.raises(RemoteError, match="answer"):
                await ask(client)

    asyncio.run(test())
