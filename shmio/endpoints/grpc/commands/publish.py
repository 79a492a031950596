"""Values that clients send toward sources, whichever wire they come by."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Final, NamedTuple

import grpc
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError

from shmio.endpoints.grpc.commands.path_kind import Shape, shape
from shmio.endpoints.grpc.commands.topics import Topics
from shmio.endpoints.grpc.injection.injections import ShadowKind, Shadows
from shmio.endpoints.grpc.server.rejected_calls import Refusals
from shmio.endpoints.in_flight import Done, End, in_words, worst
from shmio.errors import CommandError, ShmioError, ValueRangeError
from shmio.layout.topic import shorten
from shmio.segment import DONE, EventKind

TURNS: Final = 3
"""One of gRPC's threads may be held up by the machine with what it has received, while others go on."""


class ReceiveBarrier:
    """A turn of the queue through which all that gRPC has received goes to the event loop.

    What a handler is waiting for and has come lies in that queue; so does, behind it, the end of an operation that has
    nothing to wait for: that a channel which was never used is not shut down.
    """

    def __init__(self) -> None:
        self._channel: grpc.aio.Channel | None = None

    async def handled(self) -> None:
        """Wait until handlers have been given what came before."""
        if self._channel is None:
            self._channel = grpc.aio.insecure_channel("unix:///dev/null")
        for _ in range(TURNS):
            await self._channel.wait_for_state_change(grpc.ChannelConnectivity.SHUTDOWN)

    async def close(self) -> None:
        """Nothing is waited for any more."""
        if self._channel is not None:
            await self._channel.close()


SETTLE_S: Final = 5.0
"""So long a step waits for what its client has sent before it, and goes on sending."""
MAX_VALUES: Final = 256
"""Registers that one structure may write at once; a cycle of the source takes as many."""
LARGE_ELEMENTS: Final = 1024
"""An array of as many takes noticeable time to read."""


class _Destination(NamedTuple):
    """Where a value goes. ``send``: as :meth:`CommandClient.send`; ``ready``: whether that would not have to wait."""

    send: Callable[[Done, Callable[[], None]], Coroutine[None, None, None]]
    ready: bool


class Request(NamedTuple):
    """One value for one topic; ``read`` says what it is for each register, by path, or raises ValueRangeError."""

    path: str
    read: Callable[[Shape], Mapping[str, object]]


Parse = Callable[[bytes], Request]
"""What a message asks for; DecodeError: it is none."""


class _PublishCall:
    """One Publish call: how many of its values are under way, and who waits for them."""

    def __init__(self) -> None:
        self.received = 0
        self.open = 0
        self.settled: asyncio.Future[None] | None = None
        self.unanswered = 0  # values that their source has neither accepted nor refused
        self._answered: asyncio.Future[None] | None = None

    async def answered(self) -> None:
        """Wait until sources have answered all that has been received."""
        while self.unanswered:
            self._answered = self._answered or asyncio.get_running_loop().create_future()
            await asyncio.shield(self._answered)

    def answer(self) -> None:
        """One is answered."""
        self.unanswered -= 1
        if not self.unanswered and self._answered is not None:
            self._answered.set_result(None)
            self._answered = None


class _PublishedValue:
    """One value of a stream."""

    def __init__(self, stream: _PublishCall) -> None:
        self._stream = stream
        self._answered = False
        stream.open += 1
        stream.unanswered += 1

    def answer(self) -> None:
        """Its source has accepted or refused it."""
        if not self._answered:
            self._answered = True
            self._stream.answer()

    def end(self) -> None:
        """It has its end."""
        self.answer()
        stream = self._stream
        stream.open -= 1
        if stream.open == 0 and stream.settled is not None and not stream.settled.done():
            stream.settled.set_result(None)


async def _read(request: Request, found: Shape) -> Mapping[str, object]:
    """A request's values; those of a large array beside the event loop. ValueRangeError."""
    if found.elements < LARGE_ELEMENTS:
        return request.read(found)
    return await asyncio.to_thread(request.read, found)


class Publisher:
    """Serves Publish. One wrong message ends neither its stream nor anything else: it is counted, logged, passed over.

    Every message is in the end one of ``published``, the device has it, or ``refused``.
    """

    def __init__(self, topics: Topics, shadows: Shadows) -> None:
        self.published = 0
        self._topics = topics
        self._shadows = shadows
        self._refusals = Refusals()
        self._waiting: set[asyncio.Task[None]] = set()
        self._streams: dict[str, set[_PublishCall]] = {}  # of each peer
        self._arrivals = ReceiveBarrier()

    @property
    def refused(self) -> int:
        """Messages that were not carried out, or of which it is not known."""
        return self._refusals.count

    async def publish(self, messages: AsyncIterator[bytes], parse: Parse, peer: str) -> Empty:
        """Take a stream's messages in order; return when the end of each is known, after the stream's.

        What was taken is carried out even if the client is gone meanwhile.
        """
        stream = _PublishCall()
        streams = self._streams.setdefault(peer, set())
        streams.add(stream)
        try:
            async for message in messages:
                stream.received += 1
                await self._take(stream, message, parse, peer)
            if stream.open:
                stream.settled = asyncio.get_running_loop().create_future()
                await stream.settled
        finally:
            streams.discard(stream)
            if not streams:
                self._streams.pop(peer, None)
        return Empty()

    async def _take(self, stream: _PublishCall, message: bytes, parse: Parse, peer: str) -> None:
        path, value = "", _PublishedValue(stream)
        try:
            request = parse(message)
            path = request.path
            destination = await self._resolve(request)
        except DecodeError:
            self._refusals.add(f"{len(message)} bytes are no PubRequest", path, peer)
            value.end()
            return
        except ShmioError as error:
            self._refusals.add(str(error), path, peer)
            value.end()
            return
        except BaseException:  # its call ends
            value.end()
            raise
        sending = self._send(destination, partial(self._ended, value, path, peer), value.answer)
        if destination.ready:
            await sending
        else:  # meanwhile nothing is read: the client is slowed down by the flow control of its stream
            await asyncio.shield(self._keep(sending))

    async def settle(self, peer: str) -> None:
        """Wait until sources have accepted or refused all that has come on a client's streams.

        What has come and was not read yet is read. A client that goes on sending is waited for ``SETTLE_S`` at most.
        """
        if peer not in self._streams:
            return
        before: dict[_PublishCall, int] = {}
        with suppress(TimeoutError):
            async with asyncio.timeout(SETTLE_S):
                while (now := {stream: stream.received for stream in self._streams.get(peer, ())}) != before:
                    for stream in now:
                        await stream.answered()
                    before = now
                    await self._arrivals.handled()

    async def write(self, request: Request, peer: str) -> tuple[EventKind, str]:
        """Write one value: (ACCEPTED, "") as soon as its source has accepted it, else how it ended before, and why.

        PathError, ValueRangeError, CommandError: it was not sent. Of one that was accepted the log says if the device
        does not take it after all.
        """
        answer: asyncio.Future[tuple[EventKind, str]] = asyncio.get_running_loop().create_future()

        def accepted() -> None:
            if not answer.done():
                answer.set_result((EventKind.ACCEPTED, ""))

        def ended(ends: Sequence[End]) -> None:
            end = worst(ends)
            if end[0] in DONE:
                self.published += 1
                accepted()  # which nobody said, if an injection took all of it
            elif answer.done():
                self._refusals.add(in_words(end), request.path, peer)
            else:
                self._refusals.count += 1
                answer.set_result((end[0], in_words(end)))

        try:
            destination = await self._resolve(request)
            await destination.send(ended, accepted)
        except ShmioError:
            self._refusals.count += 1
            raise
        return await answer

    async def _resolve(self, request: Request) -> _Destination:
        """What is to be written where; PathError, ValueRangeError, CommandError."""
        if shadow := self._shadows.find(request.path):
            if shadow.kind is ShadowKind.ORIGINALS:
                raise CommandError(f"{shorten(request.path)}: originals come from here; values go to the shadow's /in")
            injection = shadow.injection
            values = await _read(request, injection.shape)
            return _Destination(partial(injection.give, values), injection.ready(values))
        topic = self._topics.topic(request.path)
        found = shape(self._topics.layout(topic), topic)
        if topic.direction == "out":
            raise CommandError(f"{shorten(request.path)}: what comes out of a source is not published to; use /in")
        values = await _read(request, found)
        if len(values) > MAX_VALUES:
            raise ValueRangeError(
                f"{shorten(request.path)}: {len(values)} registers are too many at once, at most {MAX_VALUES}"
            )
        commands = self._topics.feed(topic.source).commands
        return _Destination(partial(commands.send, values), commands.ready(values))

    async def _send(self, destination: _Destination, done: Done, accepted: Callable[[], None]) -> None:
        try:
            await destination.send(done, accepted)
        except ShmioError as error:
            done([(EventKind.REJECTED, str(error))])

    def _keep(self, sending: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(sending)
        self._waiting.add(task)
        task.add_done_callback(self._waiting.discard)
        return task

    def _ended(self, value: _PublishedValue, path: str, peer: str, ends: Sequence[End]) -> None:
        end = worst(ends)
        if end[0] in DONE:
            self.published += 1
        else:
            self._refusals.add(in_words(end), path, peer)
        value.end()
