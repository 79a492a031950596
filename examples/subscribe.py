"""Print the values of topics from another process or host, by SimlogAPI version 1.

python examples/subscribe.py [--count N] HOST:PORT TOPIC...
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import sys
from typing import Any

import grpc

from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub


async def follow(stub: Any, path: str, count: int | None) -> None:
    """Print a topic's values as they come; the first is the present one."""
    stream = stub.Subscribe(TopicDescriptor(path=path))
    for _ in itertools.count() if count is None else range(count):
        message = await stream.read()
        if message is grpc.aio.EOF:
            return
        print(f"{message.timeStamp.stamp.nsec / 1e9:10.3f} s  {path}  {message.value}", flush=True)
    stream.cancel()


async def main() -> int:
    """Subscribe to all topics at once; exit status 1 when the server refuses or is not there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, help="stop after so many values of each topic")
    parser.add_argument("address", metavar="HOST:PORT")
    parser.add_argument("topics", metavar="TOPIC", nargs="+")
    options = parser.parse_args()
    async with grpc.aio.insecure_channel(options.address) as channel:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        try:
            await asyncio.gather(*(follow(stub, path, options.count) for path in options.topics))
        except grpc.aio.AioRpcError as error:
            print(f"{options.address}: {error.code().name}: {error.details()}", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    try:
        sys.exit(asyncio.run(main()))
    except KeyboardInterrupt:
        sys.exit(130)
