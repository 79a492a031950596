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
    """The stream: a program with more to say would go on. Its end is the half-close."""
    for topic, text in zip(topics, texts, strict=True):
        yield PubRequest(topic=topic, data=ROSMessage(type=topic.msgType, value=text))


def channel_to(options: argparse.Namespace) -> grpc.aio.Channel:
    """A channel in plain text, or by TLS."""
    if options.ca is None:
        return grpc.aio.insecure_channel(options.address)
    ca, key, certificate = (file and file.read_bytes() for file in (options.ca, options.key, options.certificate))
    return grpc.aio.secure_channel(options.address, grpc.ssl_channel_credentials(ca, key, certificate))


async def main() -> int:
    """Publish in the order given; exit status 1 when a topic is not there, or the server.

    Publish itself tells of no value that was refused; the server's log does, and the topic as it then reads.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ca", type=Path, help="use TLS, and trust this authority (PEM)")
    parser.add_argument("--certificate", type=Path, help="our own certificate (PEM), where the server asks for one")
    parser.add_argument("--key", type=Path, help="its key (PEM)")
    parser.add_argument("--token-file", type=Path, help="the token to send, where the server asks for one")
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH")
    parser.add_argument("words", metavar="TOPIC VALUE", nargs="+")
    options = parser.parse_args()
    paths, texts = options.words[::2], options.words[1::2]
    if len(paths) != len(texts):
        parser.error(f"no value for {paths[-1]}")
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
    print(f"{len(texts)} sent, and the server is done with them; what was refused is named in its log")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(asyncio.run(main()))
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # who read our output went away, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except OSError as error:
        sys.exit(f"{error.filename}: {error.strerror}")
