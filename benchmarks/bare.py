"""A bare grpc.aio server, as a process: every call gets the same ready bytes, as fast as its client takes them."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from typing import Any

import grpc
from common import tell


class Everything(grpc.GenericRpcHandler):
    """Answers any call."""

    def __init__(self, message: bytes) -> None:
        self._message = message

    def service(self, _: Any) -> Any:
        return grpc.unary_stream_rpc_method_handler(self._stream)

    async def _stream(self, _request: bytes, _context: Any) -> AsyncIterator[bytes]:
        while True:
            yield self._message


async def main() -> None:
    server = grpc.aio.server()
    server.add_generic_rpc_handlers([Everything(bytes(int(sys.argv[1])))])
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    tell(f"127.0.0.1:{port}")
    await asyncio.to_thread(sys.stdin.read)
    await server.stop(0)


if __name__ == "__main__":
    asyncio.run(main())
