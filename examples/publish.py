"""Write values of topics from another process or host, by SimlogAPI version 1.

python examples/publish.py [--ca CA.pem [--certificate C.pem --key K.pem]] [--token-file FILE]
    HOST:PORT|unix:PATH TOPIC VALUE [TOPIC VALUE]...
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import grpc

from shmio.wire.simlog_v1_pb2 import PubRequest, ROSMessage, TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub


async def values(topics: list[TopicDescriptor], texts: list[str]) -> AsyncIterator[PubRequest]:
    """Yield the messages of the stream. The stream ends with them; another program may continue it."""
    for topic, text in zip(topics, texts, strict=True):
        yield PubRequest(topic=topic, data=ROSMessage(type=topic.msgType, value=text))


def channel_to(options: argparse.Namespace) -> grpc.aio.Channel:
    """Open a channel in plain text, or with TLS."""
    if options.ca is None:
        return grpc.aio.insecure_channel(options.address)
    ca, key, certificate = (file and file.read_bytes() for file in (options.ca, options.key, options.certificate))
    return grpc.aio.secure_channel(options.address, grpc.ssl_channel_credentials(ca, key, certificate))


async def main() -> int:
    """Publish in the given order. Return 1 if a topic does not exist, or the server is not there.

    Publish does not report refused values. The server's log names them, and a read of the topic shows its value.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ca", type=Path, help="use TLS, and trust this authority (PEM)")
    parser.add_argument("--certificate", type=Path, help="our own certificate (PEM), if the server requires one")
    parser.add_argument("--key", type=Path, help="the key of our certificate (PEM)")
    parser.add_argument("--token-file", type=Path, help="file with the token, if the server requires one")
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH")
    parser.add_argument("words", metavar="TOPIC VALUE", nargs="+")
    options = parser.parse_args()
    paths, texts = options.words[::2], options.words[1::2]
    if len(paths) != len(texts):
        parser.error(f"missing value for topic {paths[-1]}")
    async with channel_to(options) as channel:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        token = options.token_file and options.token_file.read_text().strip()
        metadata = token and [("authorization", f"Bearer {token}")]
        try:
            topics = [await stub.GetTopic(TopicDescriptor(path=path), metadata=metadata) for path in paths]
            await stub.Publish(values(topics, texts), metadata=metadata)
        except grpc.aio.AioRpcError as error:
            print(f"{options.address}: {error.code().name}: {error.details()}", file=sys.stderr)
            return 1
    print(f"sent {len(texts)} values; the server has handled them, and its log names those that it refused")
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
