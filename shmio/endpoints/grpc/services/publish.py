"""Writes the values that clients publish, for both versions of SimlogAPI."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Final, NamedTuple

import grpc
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError

from shmio.audit import trail
from shmio.endpoints.commands_in_flight import Done, in_words
from shmio.endpoints.grpc.server.call_guard import Refusals
from shmio.endpoints.grpc.services.injection import ShadowKind, Shadows
from shmio.endpoints.grpc.topics import Shape, Topics, shape
from shmio.errors import CommandError, ShmioError, ValueRangeError
from shmio.layout.topic import shorten
from shmio.segment import DONE, EventKind
from shmio.segment.commands import End, worst

TURNS: Final = 3
"""Number of times that the barrier passes through gRPC's queue.

Several times are necessary because one of gRPC's threads may pass a message on late.
"""


class ReceiveBarrier:
    """Waits until the handlers have received all messages that gRPC has received so far.

    gRPC passes received messages to the event loop through a queue. The barrier appends an
    operation to this queue, and waits for its end. The operation ends at once: it checks the state
    of an unused channel.
    """

    def __init__(self) -> None:
        self._channel: grpc.aio.Channel | None = None

    async def handled(self) -> None:
        """Wait until the handlers have received all messages that gRPC received before this call."""
        if self._channel is None:
            self._channel = grpc.aio.insecure_channel("unix:///dev/null")
        for _ in range(TURNS):
            await self._channel.wait_for_state_change(grpc.ChannelConnectivity.SHUTDOWN)

    async def close(self) -> None:
        """Close the channel that the barrier uses."""
        if self._channel is not None:
            await self._channel.close()


SETTLE_S: Final = 5.0
"""Maximum time in s for which a step waits for a client that continues to send values."""
MAX_VALUES: Final = 256
"""Maximum number of registers in a structure: as many as a source writes in one cycle."""
LARGE_ELEMENTS: Final = 1024
"""Number of elements from which an array is read in a thread, because reading it takes time."""


class _Destination(NamedTuple):
    """The receiver of a value.

    ``send`` sends the value. ``ready`` returns whether ``send`` could do so without waiting.
    """

    send: Callable[[Done, Callable[[], None]], Coroutine[None, None, None]]
    ready: bool


class Request(NamedTuple):
    """A client's request to write a value to a topic.

    ``read`` returns the values by register path, or raises ValueRangeError.
    """

    path: str
    read: Callable[[Shape], Mapping[str, object]]


Parse = Callable[[bytes], Request]
"""Function that parses a message; it raises DecodeError if the message is not valid."""


class _PublishCall:
    """A Publish call, with the number of its values in flight."""

    def __init__(self) -> None:
        self.received = 0
        self.open = 0
        self.settled: asyncio.Future[None] | None = None
        self.unanswered = 0  # values that no source has accepted or refused yet
        self._answered: asyncio.Future[None] | None = None

    async def answered(self) -> None:
        """Wait until the sources have accepted or refused all values received so far."""
        while self.unanswered:
            self._answered = self._answered or asyncio.get_running_loop().create_future()
            await asyncio.shield(self._answered)

    def answer(self) -> None:
        """Note that a source has accepted or refused a value."""
        self.unanswered -= 1
        if not self.unanswered and self._answered is not None:
            self._answered.set_result(None)
            self._answered = None


class _PublishedValue:
    """A value of a Publish call."""

    def __init__(self, stream: _PublishCall) -> None:
        self._stream = stream
        self._answered = False
        stream.open += 1
        stream.unanswered += 1

    def answer(self) -> None:
        """Note that the source has accepted or refused the value."""
        if not self._answered:
            self._answered = True
            self._stream.answer()

    def end(self) -> None:
        """Note that the value's outcome is known."""
        self.answer()
        stream = self._stream
        stream.open -= 1
        if stream.open == 0 and stream.settled is not None and not stream.settled.done():
            stream.settled.set_result(None)


async def _read(request: Request, found: Shape) -> Mapping[str, object]:
    """Return the values of a request; large arrays are read in a thread.

    Raises:
        ValueRangeError: A value does not fit its register.

    """
    if found.elements < LARGE_ELEMENTS:
        return request.read(found)
    return await asyncio.to_thread(request.read, found)


class Publisher:
    """Serves Publish and Write.

    An invalid message in a stream is counted, logged and skipped; the stream continues. A message
    counts as ``published`` once the device has its value, otherwise as ``refused``.
    """

    def __init__(self, topics: Topics, shadows: Shadows) -> None:
        self.published = 0
        self._topics = topics
        self._shadows = shadows
        self._refusals = Refusals()
        self._waiting: set[asyncio.Task[None]] = set()
        self._streams: dict[str, set[_PublishCall]] = {}  # by peer
        self._arrivals = ReceiveBarrier()

    @property
    def refused(self) -> int:
        """Number of messages whose value was not written, or whose outcome is unknown."""
        return self._refusals.count

    async def publish(self, messages: AsyncIterator[bytes], parse: Parse, peer: str) -> Empty:
        """Write the values of a stream in order. Return when all outcomes are known.

        Even if the client disconnects, the values received until then are written.

        Args:
            messages: The serialised messages of the stream.
            parse: Parses a message.
            peer: The client.
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
            reason = f"{len(message)} bytes are not a valid PubRequest"
            self._refusals.add(reason, path, peer)
            trail.record("write", {}, "refused", reason)
            value.end()
            return
        except ShmioError as error:
            self._refusals.add(str(error), path, peer)
            trail.record("write", {"topic": path}, "refused", str(error))
            value.end()
            return
        except BaseException:  # such as the cancellation of the call
            value.end()
            raise
        sending = self._send(destination, partial(self._ended, value, path, peer), value.answer)
        if destination.ready:
            await sending
        else:  # the handler reads nothing meanwhile, so flow control slows the client down
            await asyncio.shield(self._keep(sending))

    async def settle(self, peer: str) -> None:
        """Wait until sources have accepted or refused all values received so far from a client.

        This includes values that gRPC has received, but the handler has not read yet. If the client
        continues to send, the wait ends after ``SETTLE_S``.
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
        """Write one value. Return when its source has accepted or refused it.

        If the device does not take a value that was accepted, a log line says so later. If this
        raises an error, nothing was sent.

        Returns:
            ``(ACCEPTED, "")``, or the outcome and its reason if the source did not accept the
            value.

        Raises:
            PathError: There is no such topic.
            ValueRangeError: The value does not fit.
            CommandError: The topic is not writable, or the source does not answer.

        """
        answer: asyncio.Future[tuple[EventKind, str]] = asyncio.get_running_loop().create_future()

        def accepted() -> None:
            if not answer.done():
                answer.set_result((EventKind.ACCEPTED, ""))

        def ended(ends: Sequence[End]) -> None:
            end = worst(ends)
            if end[0] in DONE:
                self.published += 1
                accepted()  # there is no ACCEPTED event if an injection diverted the whole value
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
        """Find the receiver of a request's value. This method raises the errors of :meth:`write`."""
        if shadow := self._shadows.find(request.path):
            if shadow.kind is ShadowKind.ORIGINALS:
                raise CommandError(
                    f"{shorten(request.path)}: this topic delivers the originals; publish values to the shadow's /in"
                )
            injection = shadow.injection
            values = await _read(request, injection.shape)
            return _Destination(partial(injection.give, values), injection.ready(values))
        topic = self._topics.topic(request.path)
        found = shape(self._topics.layout(topic), topic)
        if topic.direction == "out":
            raise CommandError(f"{shorten(request.path)}: clients cannot publish to an output of a source; use /in")
        values = await _read(request, found)
        if len(values) > MAX_VALUES:
            raise ValueRangeError(
                f"{shorten(request.path)}: {len(values)} registers are too many for one value; at most "
                f"{MAX_VALUES} are allowed"
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
