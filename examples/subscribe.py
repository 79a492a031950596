"""Print the values of topics from another process or host, by SimlogAPI version 1.

python examples/subscribe.py [--count N] [--ca CA.pem [--certificate C.pem --key K.pem]] [--token-file FILE]
    HOST:PORT|unix:PATH TOPIC...
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import os
import sys
from pathlib import Path
from typing import Any

import grpc

from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

STOPPED = ("Cancelling all calls", "Socket closed")
"""Texts by which gRPC reports that the server has ended."""


async def follow(stub: Any, path: str, options: argparse.Namespace) -> None:
    """Print a topic's values as they arrive. The first is the present value."""
    count = options.count
    metadata = options.token_file and [("authorization", f"Bearer {options.token_file.read_text().strip()}")]
    stream = stub.Subscribe(TopicDescriptor(path=path), metadata=metadata)
    for _ in itertools.count() if count is None else range(count):
        message = await stream.read()
        if message is grpc.aio.EOF:
            return
        print(f"{message.timeStamp.stamp.nsec / 1e9:10.3f} s  {path}  {message.value}", flush=True)
    stream.cancel()


def channel_to(options: argparse.Namespace) -> grpc.aio.Channel:
    """Open a channel in plain text, or with TLS."""
    if options.ca is None:
        return grpc.aio.insecure_channel(options.address)
    ca, key, certificate = (file and file.read_bytes() for file in (options.ca, options.key, options.certificate))
    return grpc.aio.secure_channel(options.address, grpc.ssl_channel_credentials(ca, key, certificate))


async def main() -> int:
    """Subscribe to all topics at once. Return 1 if the server refuses or is not there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, help="stop after this number of values of each topic")
    parser.add_argument("--ca", type=Path, help="use TLS, and trust this authority (PEM)")
    parser.add_argument("--certificate", type=Path, help="our own certificate (PEM), if the server requires one")
    parser.add_argument("--key", type=Path, help="its key (PEM)")
    parser.add_argument("--token-file", type=Path, help="file with the token, if the server requires one")
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH")
    parser.add_argument("topics", metavar="TOPIC", nargs="+")
    options = parser.parse_args()
    async with channel_to(options) as channel:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        try:
            await asyncio.gather(*(follow(stub, path, options) for path in options.topics))
        except grpc.aio.AioRpcError as error:
            stopped = error.details() in STOPPED
            told = "the endpoint has stopped" if stopped else f"{error.code().name}: {error.details()}"
            print(f"{options.address}: {told}", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    try:
        sys.exit(asyncio.run(main()))
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader of our output has ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except OSError as error:
        sys.exit(f"{error.filename}: {error.strerror}")
