"""An endpoint that ends a call while it stops."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
import pytest

from shmio.errors import LostError
from tests.unit.client.both import BOTH, Connect


@BOTH
def test_cancelled_call_is_reported_as_the_end_of_the_endpoint(connects: Connect) -> None:
    def cancel(_requests: Any, context: grpc.ServicerContext) -> None:
        context.abort(grpc.StatusCode.CANCELLED, "CANCELLED")  # as grpc.aio ends the calls of a server that stops

    class Stopping(grpc.GenericRpcHandler):
        def service(self, _: Any) -> Any:
            return grpc.stream_stream_rpc_method_handler(cancel)

    async def test() -> None:
        async with connects(f"127.0.0.1:{port}") as client:
            with pytest.raises(LostError, match="has ended: the endpoint has stopped"):
                await client.layouts()

    server = grpc.server(ThreadPoolExecutor(1), [Stopping()])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        asyncio.run(test())
    finally:
        server.stop(None).wait()
