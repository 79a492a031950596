"""A process with a bare grpc.aio server: for each step call, it sends prepared messages on the stream, then answers.

The messages are those that an endpoint sent to the same client before, byte for byte: see ``ready.py``. If an instance
is named, the server also makes each step there, as a program on the host, but does not read the new values.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack
from typing import Any

import grpc
from common import tell
from ready import Ready

from shmio import attach


class Bare(grpc.GenericRpcHandler):
    """Handlers for all calls of a stepping client. The server has one client at a time."""

    def __init__(self, ready: Ready, instance: str) -> None:
        self._ready = ready
        self._instance = instance
        self._move: Callable[[], object] = lambda: None
        self._asked: asyncio.Queue[asyncio.Future[None]] = asyncio.Queue()
        self._handlers: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            ready.stream: grpc.unary_stream_rpc_method_handler(self._follow),
            ready.call: grpc.unary_unary_rpc_method_handler(self._step),
            ready.steps: grpc.stream_stream_rpc_method_handler(self._steps),
        }
        self._other: grpc.RpcMethodHandler[Any, Any] = grpc.unary_unary_rpc_method_handler(self._nothing)

    def service(self, handler_call_details: Any) -> grpc.RpcMethodHandler[Any, Any] | None:
        """Return the handler of a call."""
        handler: grpc.RpcMethodHandler[Any, Any] = self._handlers.get(handler_call_details.method, self._other)
        return handler

    async def _follow(self, _: bytes, context: Any) -> AsyncIterator[bytes]:
        asked = self._asked = asyncio.Queue()
        await context.send_initial_metadata(())
        with ExitStack() as stack:
            if self._instance:
                self._move = stack.enter_context(attach(self._instance, writable=True)).step
            for message in self._ready.first:
                yield message
            while True:
                done = await asked.get()
                for message in self._ready.step:
                    yield message
                done.set_result(None)

    async def _step(self, _: bytes, __: Any) -> bytes:
        self._move()
        done = asyncio.get_running_loop().create_future()
        self._asked.put_nowait(done)
        await done
        return self._ready.answer

    async def _steps(self, requests: AsyncIterator[bytes], context: Any) -> AsyncIterator[bytes]:
        async for request in requests:
            await self._step(request, context)
            yield self._ready.steps_answer

    async def _nothing(self, _: bytes, __: Any) -> bytes:
        return b""


async def serve(ready: Ready, instance: str) -> None:
    """Serve until standard input ends."""
    server = grpc.aio.server()
    server.add_generic_rpc_handlers((Bare(ready, instance),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    tell(f"127.0.0.1:{port}")
    await asyncio.to_thread(sys.stdin.read)
    await server.stop(None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ready", help="the messages to send, as JSON (see ready.py)")
    parser.add_argument("instance", nargs="?", default="", help="the instance to step; without it, no model computes")
    arguments = parser.parse_args()
    asyncio.run(serve(Ready.of(arguments.ready), arguments.instance))


if __name__ == "__main__":
    main()
