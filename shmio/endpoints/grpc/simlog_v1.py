"""SimlogAPI version 1, package ``simulation.server``: GetTopic, Subscribe and Publish; no more for now."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Collection, Mapping
from functools import lru_cache, partial
from typing import Any, Final

import grpc
from google.protobuf.empty_pb2 import Empty

from shmio.endpoints.grpc.echo import Picture
from shmio.endpoints.grpc.feed import CATCH_UP_FRAMES, Feed
from shmio.endpoints.grpc.inlet import Inlet
from shmio.endpoints.grpc.publish import Publisher
from shmio.endpoints.grpc.queue import ConflatingQueue, UnbrokenQueue
from shmio.errors import PathError
from shmio.layout.codec import codec
from shmio.layout.model import Layout, Register
from shmio.layout.text import to_text, wire_type
from shmio.layout.topic import Topic, find, look_up, parse_topic, shorten
from shmio.segment.events import EVENT_SLOTS
from shmio.wire import simlog_v1_pb2 as wire

SERVICE = wire.DESCRIPTOR.services_by_name["SimlogAPI"].full_name
QUEUE_BOUND: Final = 2 * CATCH_UP_FRAMES  # a feed that catches up delivers so many at once
EVENT_BOUND: Final = 2 * EVENT_SLOTS  # an inlet that catches up delivers half of it at once
EVENT_BOUND_BYTES: Final = 8 << 20

Context = grpc.aio.ServicerContext[Any, Any]


class SimlogV1:
    """Serves the registers of all sources as text values."""

    def __init__(self, feeds: Mapping[str, Feed], default_source: str | None) -> None:
        """``default_source``: that of paths which name none; default: the only one."""
        self._feeds = feeds
        self._default = default_source
        self._streams: set[_OutStream | _InStream] = set()
        self._dropped = 0
        self._publisher = Publisher(self._locate_in)

    @property
    def counters(self) -> tuple[int, int, int, int]:
        """Streams of subscribers open, messages dropped on slow ones, messages published, and refused."""
        dropped = self._dropped + sum(stream.dropped for stream in self._streams)
        return len(self._streams), dropped, self._publisher.published, self._publisher.refused

    def handlers(self) -> grpc.GenericRpcHandler:
        """The service's calls, for a server."""
        decode = wire.TopicDescriptor.FromString
        calls = {
            "GetTopic": grpc.unary_unary_rpc_method_handler(
                self.get_topic, decode, wire.TopicDescriptor.SerializeToString
            ),
            # No serializer: a change is encoded once, by the feed, and its bytes go to every stream.
            "Subscribe": grpc.unary_stream_rpc_method_handler(self.subscribe, decode),
            # No deserializer either: bytes that are no message must not end the stream.
            "Publish": grpc.stream_unary_rpc_method_handler(self.publish, None, Empty.SerializeToString),
        }
        return grpc.method_handlers_generic_handler(SERVICE, calls)

    async def get_topic(self, request: wire.TopicDescriptor, context: Context) -> wire.TopicDescriptor:
        """Tell a topic's type; NOT_FOUND, INVALID_ARGUMENT for a structure."""
        _, register = await self._resolve(request.path, context)
        return wire.TopicDescriptor(path=request.path, msgType=wire_type(register))

    async def subscribe(self, request: wire.TopicDescriptor, context: Context) -> AsyncIterator[bytes]:
        """Stream a topic's values: the current one if it is good, then every change; of ``/in``, what is written to it.

        While quality is bad nothing is sent; on recovery the value is sent again. A slow client is
        given the newest value in place of those that wait; but its stream of ``/in``, where none replaces another, ends
        with RESOURCE_EXHAUSTED. When a reload changes the source the stream goes on, if there still is such a register;
        else it ends with NOT_FOUND.
        """
        topic, register = await self._resolve(request.path, context)
        stream = _InStream(topic.source) if topic.direction == "in" else _OutStream(topic.source)
        self._streams.add(stream)
        told = False
        try:
            while True:
                leave = self._join(register, stream)
                try:
                    if not told:
                        await context.send_initial_metadata(())  # who waits for it misses nothing from then on
                        told = True
                    while (message := await stream.pop()) is not None:
                        yield message
                finally:
                    leave()
                if isinstance(stream, _InStream) and stream.failure:
                    await context.abort(
                        grpc.StatusCode.RESOURCE_EXHAUSTED, f"{shorten(request.path)}: {stream.failure}"
                    )
                register = await self._find_again(topic, request.path, context)
        finally:
            self._streams.discard(stream)
            self._dropped += stream.dropped

    def move(self, sources: Collection[str]) -> None:
        """Have the streams of these sources go over to the feeds that there are by now."""
        for stream in self._streams:
            if stream.source in sources:
                stream.end()

    def _join(self, register: Register, stream: _OutStream | _InStream) -> Callable[[], None]:
        """Have the stream listen; how it leaves again."""
        feed = self._feeds[stream.source]
        encode = encoder(register, feed.block.layout)
        if isinstance(stream, _InStream):
            echo = feed.inlet.echo
            echo.listen(register, encode, stream)
            return partial(echo.leave, register, stream)
        feed.listen(register, encode, stream)
        return partial(feed.leave, register, stream)

    async def _find_again(self, topic: Topic, path: str, context: Context) -> Register:
        """The register of a stream after a reload; NOT_FOUND."""
        try:
            if topic.source not in self._feeds:
                raise PathError(f"{shorten(path)}: source {topic.source} was removed by a reload")
            return find(self._feeds[topic.source].block.layout, topic.path)
        except PathError as error:
            await context.abort(grpc.StatusCode.NOT_FOUND, str(error))
            raise  # abort never returns

    async def publish(self, messages: AsyncIterator[bytes], context: Context) -> Empty:
        """Write the values of a stream, in its order, and answer when it has ended and all of them have."""
        return await self._publisher.publish(messages, context.peer())

    async def _resolve(self, path: str, context: Context) -> tuple[Topic, Register]:
        try:
            topic = self._topic(path)
            layout = self._feeds[topic.source].block.layout
            if layout.members(topic.path) or not topic.path:
                await context.abort(
                    grpc.StatusCode.INVALID_ARGUMENT, f"{shorten(path)}: a structure; version 1 serves single registers"
                )
            return topic, look_up(layout, topic)
        except PathError as error:
            await context.abort(grpc.StatusCode.NOT_FOUND, str(error))
            raise  # abort never returns

    def _locate_in(self, path: str) -> tuple[Topic, Inlet, Register]:
        topic = self._topic(path)
        feed = self._feeds[topic.source]
        return topic, feed.inlet, look_up(feed.block.layout, topic)

    def _topic(self, path: str) -> Topic:
        default = self._default or (next(iter(self._feeds)) if len(self._feeds) == 1 else None)
        topic = parse_topic(path, self._feeds, default)
        if topic.source not in self._feeds:
            raise PathError(f"{shorten(path)}: {topic.source} is reserved, and this version serves nothing there")
        return topic


class _OutStream(ConflatingQueue):
    """One Subscribe call of what comes out of a source, as a feed's listener."""

    def __init__(self, source: str) -> None:
        super().__init__(QUEUE_BOUND)
        self.source = source
        self.since = 0

    def deliver(self, message: bytes) -> None:
        self.push(message)

    def lose(self) -> None:
        self.clear()


class _InStream(UnbrokenQueue):
    """One Subscribe call of ``/in``, as an echo's listener."""

    def __init__(self, source: str) -> None:
        super().__init__(EVENT_BOUND, EVENT_BOUND_BYTES)
        self.source = source

    def deliver(self, message: bytes) -> None:
        self.push(message)


def encoder(register: Register, layout: Layout) -> Callable[[Picture], bytes | None]:
    """A function from a frame to the register's ROSMessage, serialised; None where the bytes hold no value.

    Fields of a protobuf message may be concatenated: what never changes is encoded once, the time once a frame.
    """
    kind = wire.ROSMessage(type=wire_type(register)).SerializeToString()
    decode = codec(register, layout.byte_order).decode

    def encode(frame: Picture) -> bytes | None:
        value = decode(frame.image)
        if value is None:
            return None
        text = wire.ROSMessage(value=to_text(value, register)).SerializeToString()
        return kind + text + _time_stamp(frame.number, frame.clock_ns)

    return encode


@lru_cache(maxsize=64)  # a frame or two for each feed
def _time_stamp(number: int, clock_ns: int) -> bytes:
    stamp = wire.time(sec=clock_ns // 1_000_000_000, nsec=clock_ns)
    return wire.ROSMessage(timeStamp=wire.Header(seq=number & 0xFFFFFFFF, stamp=stamp)).SerializeToString()
