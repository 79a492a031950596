"""SimlogAPI version 1, Publish: values that clients send toward sources."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from functools import partial

from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError

from shmio.endpoints.grpc.inlet import Done, Inlet
from shmio.endpoints.grpc.refusals import Refusals
from shmio.errors import PathError, ShmioError, ValueRangeError
from shmio.layout.codec import Value
from shmio.layout.model import Register
from shmio.layout.text import from_text
from shmio.layout.topic import Topic, shorten
from shmio.wire import simlog_v1_pb2 as wire

Locate = Callable[[str], tuple[Topic, Inlet, Register]]
"""What a path names; PathError."""


class _Stream:
    """One Publish call: how many of its values are under way, and who waits for them."""

    def __init__(self) -> None:
        self.open = 0
        self.settled: asyncio.Future[None] | None = None


class Publisher:
    """Serves Publish. One wrong message ends neither its stream nor anything else: it is counted, logged, passed over.

    Every message is in the end one of ``published``, the device has it, or ``refused``.
    """

    def __init__(self, locate: Locate) -> None:
        self.published = 0
        self._locate = locate
        self._refusals = Refusals()
        self._waiting: set[asyncio.Task[None]] = set()

    @property
    def refused(self) -> int:
        """Messages that were not carried out, or of which it is not known."""
        return self._refusals.count

    async def publish(self, messages: AsyncIterator[bytes], peer: str) -> Empty:
        """Take a stream's messages in order; return when the end of each is known, after the stream's.

        What was taken is carried out even if the client is gone meanwhile.
        """
        stream = _Stream()
        async for message in messages:
            path = ""
            try:
                request = wire.PubRequest.FromString(message)
                path = request.topic.path
                inlet, register, value = self._read(request)
            except DecodeError:
                self._refusals.add(f"{len(message)} bytes are no PubRequest", path, peer)
                continue
            except ShmioError as error:
                self._refusals.add(str(error), path, peer)
                continue
            stream.open += 1
            sending = self._send(inlet, register, value, partial(self._ended, stream, path, peer))
            if inlet.ready(register):
                await sending
            else:  # meanwhile nothing is read: the client is slowed down by the flow control of its stream
                await asyncio.shield(self._keep(sending))
        if stream.open:
            stream.settled = asyncio.get_running_loop().create_future()
            await stream.settled
        return Empty()

    def _read(self, request: wire.PubRequest) -> tuple[Inlet, Register, Value]:
        """What a message asks for; PathError, ValueRangeError."""
        path = request.topic.path
        topic, inlet, register = self._locate(path)
        if topic.direction == "out":
            raise PathError(f"{shorten(path)}: what comes out of a source is not published to; use /in")
        content = request.data.WhichOneof("content")
        if content not in (None, "timeStamp"):
            raise ValueRangeError(f"a {content}; no register takes a structure")
        return inlet, register, from_text(request.data.value, register)

    async def _send(self, inlet: Inlet, register: Register, value: Value, done: Done) -> None:
        try:
            await inlet.send(register, value, done)
        except ShmioError as error:
            done(str(error))

    def _keep(self, sending: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(sending)
        self._waiting.add(task)
        task.add_done_callback(self._waiting.discard)
        return task

    def _ended(self, stream: _Stream, path: str, peer: str, reason: str) -> None:
        if reason:
            self._refusals.add(reason, path, peer)
        else:
            self.published += 1
        stream.open -= 1
        if stream.open == 0 and stream.settled is not None and not stream.settled.done():
            stream.settled.set_result(None)
