"""A process with a bare grpc.aio server, which answers every call with the same prepared bytes.

It sends as fast as its client takes the messages. With a second argument, it sends so many messages a second on each
stream, from a queue for the stream. A server whose values come from elsewhere works like that.
"""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import AsyncIterator
from typing import Any

import grpc
from common import tell

QUEUE = 64


class Everything(grpc.GenericRpcHandler):
    """A handler that accepts every call."""

    def __init__(self, message: bytes, hz: float) -> None:
        self._message = message
        self._hz = hz
        self._queues: set[asyncio.Queue[bytes]] = set()

    def service(self, _: Any) -> Any:
        return grpc.unary_stream_rpc_method_handler(self._paced if self._hz else self._stream)

    async def _stream(self, _request: bytes, _context: Any) -> AsyncIterator[bytes]:
        while True:
            yield self._message

    async def _paced(self, _request: bytes, _context: Any) -> AsyncIterator[bytes]:
        queue: asyncio.Queue[bytes] = asyncio.Queue(QUEUE)
        self._queues.add(queue)
        try:
            yield self._message
            while True:
                yield await queue.get()
        finally:
            self._queues.discard(queue)

    async def pace(self) -> None:
        """Put messages into all queues at the given rate, until the process is stopped."""
        begun_s, count = time.monotonic(), 0
        while self._hz:
            while count < (time.monotonic() - begun_s) * self._hz:
                count += 1
                for queue in self._queues:
                    if not queue.full():
                        queue.put_nowait(self._message)
            await asyncio.sleep(1 / min(self._hz, 1000))


async def main() -> None:
    handler = Everything(bytes(int(sys.argv[1])), float(sys.argv[2]) if len(sys.argv) > 2 else 0)
    server = grpc.aio.server()
    server.add_generic_rpc_handlers([handler])
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    pacing = asyncio.create_task(handler.pace())
    tell(f"127.0.0.1:{port}")
    await asyncio.to_thread(sys.stdin.read)
    pacing.cancel()
    await server.stop(0)


if __name__ == "__main__":
    asyncio.run(main())
