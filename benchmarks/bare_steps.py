"""A bare grpc.aio server, as a process: each call sends so many ready messages on the stream, and is answered then."""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import AsyncIterator
from typing import Any

import grpc
from common import tell

from shmio.wire import simlog_v2_pb2 as v2


async def serve(count: int) -> None:
    """Until standard input ends."""
    message = v2.SimlogMessage(header=v2.Header(path="sim/values/r00"), type=v2.NUMBER).SerializeToString()
    asked: asyncio.Queue[asyncio.Future[None]] = asyncio.Queue()

    async def follow(_: bytes, __: Any) -> AsyncIterator[bytes]:
        while True:
            done = await asked.get()
            for _number in range(count):
                yield message
            done.set_result(None)

    async def step(_: bytes, __: Any) -> bytes:
        done = asyncio.get_running_loop().create_future()
        asked.put_nowait(done)
        await done
        return b""

    calls: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
        "Follow": grpc.unary_stream_rpc_method_handler(follow),
        "Step": grpc.unary_unary_rpc_method_handler(step),
    }
    server = grpc.aio.server()
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("benchmark.Bare", calls),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    tell(f"127.0.0.1:{port}")
    await asyncio.to_thread(sys.stdin.read)
    await server.stop(None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    asyncio.run(serve(parser.parse_args().count))


if __name__ == "__main__":
    main()
