"""Serves SimlogAPI version 1, package ``simulation.server``, with values as ROSMessages.

The value of a register is sent as a text. A structure of a known type has its own message type. A
message is built by concatenating serialised fields: constant fields are encoded once, and the time
once for each frame.
"""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import lru_cache, partial
from typing import Any, Final

import grpc
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import Message

from shmio.endpoints.grpc.encoding import BlockImage, Encode, Subject, delimited, unless_bad, varint
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.services.injection import Injection, ShadowKind, Shadows, shadow_path
from shmio.endpoints.grpc.services.publish import Publisher, Request
from shmio.endpoints.grpc.streams.feed import Moment
from shmio.endpoints.grpc.streams.outbox import EventLane, Lane, Outbox, Outboxes, StateLane
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.topics import Shape, TimeTopic, Topics, shape
from shmio.errors import PathError, ShmioError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.simlog_structures import CONTENTS, Found, recognise
from shmio.layout.topic import Topic, shorten
from shmio.layout.values.codec import codec
from shmio.layout.values.literal import default_text, scalar_literal
from shmio.layout.values.text import from_text, to_text, wire_type
from shmio.logs import fields
from shmio.wire import simlog_v1_pb2 as wire

SERVICE: Final = wire.DESCRIPTOR.services_by_name["SimlogAPI"].full_name

_TIME_TOPIC_TYPES: Final = {TimeTopic.STEP: "int", TimeTopic.CLOCK: "time"}

log = logging.getLogger("shmio.grpc")

_Fill = Callable[[bytes, Any], None]
"""Function that fills a message with values from an image."""

_BITS: Final = {"seq": 32, "sec": 64, "nsec": 64, "msec": 64}


def message_type(found: Shape) -> str:
    """Return version 1's name for the type of a topic.

    Raises:
        ValueRangeError: The topic is a structure without a message type.

    """
    return wire_type(found.registers[0]) if found.whole else _known(found)[0]


def encoder(found: Shape, layout: Layout) -> Encode:
    """Return a function that encodes a topic as a ROSMessage, from an image.

    The function returns None if the bytes are invalid, or if the source reports a register as bad.

    Raises:
        ValueRangeError: The topic is a structure without a message type.

    """
    encode = _text(found.registers[0], layout) if found.whole else _structure(found, layout)
    return unless_bad(encode, found.registers, layout)


def read(data: wire.ROSMessage, found: Shape) -> Mapping[str, object]:
    """Convert a client's message to values by register path.

    Raises:
        ValueRangeError: The message does not fit the topic.

    """
    content = data.WhichOneof("content")
    if found.whole:
        (register,) = found.registers
        if content not in (None, "timeStamp"):
            raise ValueRangeError(f"{shorten(found.path)}: expected a text, found a {content}")
        return {register.path: from_text(data.value, register)}
    shape, members = _known(found)
    if content != CONTENTS[shape]:
        what = f"a {content}" if content else "a text"
        raise ValueRangeError(f"{shorten(found.path)}: expected a {CONTENTS[shape]}, found {what}")
    return dict(_values(getattr(data, content), members))


def _known(found: Shape) -> tuple[str, Found]:
    known = recognise(found.path, found.registers)
    if known is None:
        raise ValueRangeError(
            f"{shorten(found.path)}: version 1 has no message for this structure; use its members as topics"
        )
    return known


def _text(register: Register, layout: Layout) -> Encode:
    kind = wire.ROSMessage(type=wire_type(register)).SerializeToString()
    decode = codec(register, layout.byte_order).decode

    def encode(frame: BlockImage) -> bytes | None:
        value = decode(frame.image)
        if value is None:
            return None
        text = to_text(value, register).encode()
        return kind + (b"\x12" + delimited(text) if text else b"") + time_stamp(frame.number, frame.clock_ns)

    return encode


@lru_cache(maxsize=64)  # a frame or two for each feed
def time_stamp(number: int, clock_ns: int) -> bytes:
    """Encode a time stamp as a field of a ROSMessage.

    Args:
        number: Number of the frame or step.
        clock_ns: Time of the instance's clock, in ns.

    """
    seconds = clock_ns // 1_000_000_000
    stamp = (b"\x08" + varint(seconds) if seconds else b"") + b"\x10" + varint(clock_ns)
    return b"\x4a" + delimited(b"\x08" + varint(number & 0xFFFFFFFF) + b"\x12" + delimited(stamp))


def _structure(found: Shape, layout: Layout) -> Encode:
    shape, members = _known(found)
    kind = wire.ROSMessage(type=shape).SerializeToString()
    fill = _filler(members, layout)

    def encode(frame: BlockImage) -> bytes:
        message = wire.ROSMessage()
        content = getattr(message, CONTENTS[shape])
        content.SetInParent()  # present, even if all of it is zero
        fill(frame.image, content)
        return kind + message.SerializeToString()

    return encode


def _filler(members: Found, layout: Layout) -> _Fill:
    parts = [_member(name, member, layout) for name, member in members.items()]

    def fill(image: bytes, message: Message) -> None:
        for part in parts:
            part(image, message)

    return fill


def _member(name: str, member: Register | Found | Sequence[Found], layout: Layout) -> _Fill:
    if isinstance(member, Register):
        decode: Callable[[bytes], Any] = codec(member, layout.byte_order).decode
        convert = _converter(name, member)
        if member.dims:
            return lambda image, message: getattr(message, name).extend(map(convert, decode(image)))
        return lambda image, message: setattr(message, name, convert(decode(image)))
    if isinstance(member, Mapping):
        inner = _filler(member, layout)
        return lambda image, message: inner(image, _present(getattr(message, name)))
    each = [_filler(element, layout) for element in member]

    def fill(image: bytes, message: Any) -> None:
        for element in each:
            element(image, getattr(message, name).add())

    return fill


def _present(message: Any) -> Any:
    message.SetInParent()
    return message


def _converter(name: str, register: Register) -> Callable[[Any], Any]:
    """Return the function that converts a register's value to a field's value.

    The function converts an invalid text to an empty text.
    """
    if wire_type(register) == "string":
        return lambda value: value or ""
    if name in _BITS:
        most = (1 << _BITS[name]) - 1
        return lambda value: value & most
    return float


def _values(message: Any, members: Found) -> Iterator[tuple[str, object]]:
    """Yield the values of a message by register path. An absent inner message has no values."""
    for name, member in members.items():
        value = getattr(message, name)
        if isinstance(member, Register):
            yield member.path, _filled(value, member) if member.dims else value
        elif isinstance(member, Mapping):
            if message.HasField(name):
                yield from _values(value, member)
        else:
            if len(value) > len(member):
                raise ValueRangeError(f"{name}: expected at most {len(member)} values, found {len(value)}")
            for place, element in enumerate(member):
                yield from _values(value[place] if place < len(value) else wire.JointTrajectoryPoint(), element)


def _filled(values: Sequence[object], register: Register) -> list[object]:
    """Return a value for each element of an array. Missing values become the type's default."""
    if len(values) > register.count:
        raise ValueRangeError(f"{register.path}: expected at most {register.count} elements, found {len(values)}")
    default = scalar_literal(default_text(register.element), register.element)
    return [*values, *[default] * (register.count - len(values))]


class InjectCalls:
    """The calls of version 1 about injections."""

    def __init__(
        self,
        outboxes: Outboxes,
        shadows: Shadows,
        resolve: Callable[[str, Context], Awaitable[tuple[Topic, Shape]]],
    ) -> None:
        """Create the calls.

        Args:
            outboxes: The outboxes of all streams.
            shadows: The shadow topics of all SimlogAPI clients.
            resolve: Returns the topic and registers of a path, or ends the call with an error.

        """
        self._outboxes = outboxes
        self._shadows = shadows
        self._resolve = resolve

    async def find(self, path: str, context: Context) -> Injection | None:
        """Return the injection whose shadow topic a path names; None if there is none.

        Statuses:
            INVALID_ARGUMENT: The injection is over a structure without a message type.
        """
        shadow = self._shadows.find(path)
        if shadow is None:
            return None
        try:
            message_type(shadow.injection.shape)
        except ValueRangeError as error:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"{shorten(path)}: {error}")
        return shadow.injection

    async def inject(self, request: wire.InjectRequest, context: Context) -> AsyncIterator[bytes]:
        """Create or join an injection, and stream its originals. The injection lasts while a stream is open.

        Over ``/in``, the originals are the written values, which no longer reach the source. Over
        ``/out``, or without suffix, they are the source's values, beginning with the present value.
        Values that clients publish to the shadow topic replace the originals.

        Statuses:
            NOT_FOUND: There is no such target.
            INVALID_ARGUMENT: The target is a structure without a message type, or the path of the
                shadow topic is not usable.
            ALREADY_EXISTS: The path is in use for another target.
            FAILED_PRECONDITION: The source refuses the injection; the message says why.
            RESOURCE_EXHAUSTED: There are too many injections, or the client does not read the
                writes.
            ABORTED: The injection was lifted.
        """
        topic, found = await self._resolve(request.target.path, context)
        with self._outboxes.opened() as outbox:
            try:
                kinds = {shadow_path(request.injected.path): ShadowKind.GIVEN}
                injection = await self._shadows.create(topic, found, kinds, outbox, context.peer())
            except ShmioError as error:
                await refuse(context, error)
            release = partial(self._shadows.release, injection, outbox)
            outbox.on_failure = release  # at once, because a client that does not read delays the stream's end
            try:
                encode = encoder(injection.shape, injection.feed.block.layout)
                leave = injection.originals("v1", encode, outbox, shorten(request.target.path))
                async for message in self._messages(injection, outbox, leave, context):
                    yield message
            finally:
                release()
            await context.abort(grpc.StatusCode.ABORTED, f"{shorten(request.target.path)}: {injection.over}")

    async def given_values(self, injection: Injection, path: str, context: Context) -> AsyncIterator[bytes]:
        """Stream the values published to a shadow topic until its injection ends."""
        with self._outboxes.opened() as outbox:
            encode = encoder(injection.shape, injection.feed.block.layout)
            leave = injection.given_values("v1", encode, EventLane(outbox, shorten(path)))
            async for message in self._messages(injection, outbox, leave, context):
                yield message
            await context.abort(grpc.StatusCode.NOT_FOUND, f"{shorten(path)}: {injection.over}")

    async def _messages(
        self, injection: Injection, outbox: Outbox, leave: Callable[[], None], context: Context
    ) -> AsyncIterator[bytes]:
        """Stream an outbox's messages until the injection ends.

        Statuses:
            RESOURCE_EXHAUSTED: The client does not read the messages.
        """
        injection.ends[outbox] = outbox.end
        if injection.over:
            outbox.end()
        try:
            await context.send_initial_metadata(())  # tells the client that the shadow topic exists
            while (message := await outbox.pop()) is not None:
                yield message
        finally:
            injection.ends.pop(outbox, None)
            leave()
        if outbox.failure:
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)


class SimlogV1:
    """Serves registers of all sources as texts, and structures of known types as messages."""

    name = SERVICE

    def __init__(
        self, topics: Topics, publisher: Publisher, outboxes: Outboxes, shadows: Shadows, stepper: Stepper
    ) -> None:
        self._topics = topics
        self._publisher = publisher
        self._outboxes = outboxes
        self._injecting = InjectCalls(outboxes, shadows, self._resolve)
        self._stepper = stepper
        self._streams: dict[Outbox, str] = {}  # the source of each stream

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of the service's calls."""
        unary = grpc.unary_unary_rpc_method_handler
        decode = wire.TopicDescriptor.FromString
        calls: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "setStepSize": unary(self.set_step_size, wire.StepSizeRequest.FromString, Empty.SerializeToString),
            "step": unary(self.step, wire.StepRequest.FromString, wire.StepResponse.SerializeToString),
            "GetTopic": unary(self.get_topic, decode, wire.TopicDescriptor.SerializeToString),
            # No serializer: the feed encodes a change once for all streams.
            "Subscribe": grpc.unary_stream_rpc_method_handler(self.subscribe, decode),
            "Inject": grpc.unary_stream_rpc_method_handler(self._injecting.inject, wire.InjectRequest.FromString),
            # No deserializer: an invalid message must not end the stream.
            "Publish": grpc.stream_unary_rpc_method_handler(self.publish, None, Empty.SerializeToString),
        }
        return calls

    async def set_step_size(self, request: wire.StepSizeRequest, context: Context) -> Empty:
        """Set the step size, in ms. Time becomes virtual.

        Statuses:
            INVALID_ARGUMENT: The step size is out of range.
            FAILED_PRECONDITION: Another program controls time.
        """
        try:
            await self._stepper.set_step_size(request.step * 1_000_000)
        except ShmioError as error:
            await refuse(context, error)
        return Empty()

    async def step(self, _: wire.StepRequest, context: Context) -> wire.StepResponse:
        """Make a step. Answer when all streams have its values.

        Values that this client has published before are written first. The code of the answer is 0,
        or -1 if the step failed; then a log line says why.
        """
        try:
            await self._stepper.step(peer=context.peer())
        except ShmioError as error:
            log.warning("a step failed: %s", str(error), extra=fields(peer=context.peer()))
            return wire.StepResponse(code=-1)
        return wire.StepResponse(code=0)

    async def get_topic(self, request: wire.TopicDescriptor, context: Context) -> wire.TopicDescriptor:
        """Return the type of a topic.

        Statuses:
            NOT_FOUND: There is no such topic.
            INVALID_ARGUMENT: The topic is a structure without a message type.
        """
        if injection := await self._injecting.find(request.path, context):
            return wire.TopicDescriptor(path=request.path, msgType=message_type(injection.shape))
        if time_topic := await self._time_topic(request.path, context):
            return wire.TopicDescriptor(path=request.path, msgType=_TIME_TOPIC_TYPES[time_topic])
        _, found = await self._resolve(request.path, context)
        return wire.TopicDescriptor(path=request.path, msgType=message_type(found))

    async def subscribe(self, request: wire.TopicDescriptor, context: Context) -> AsyncIterator[bytes]:
        """Stream a topic's present value, if it is good, and its changes; for ``/in``, its writes.

        Nothing is sent while the quality is bad. When the quality recovers, the value is sent
        again. For a slow client, the newest value replaces those that wait. A slow client's stream
        of ``/in`` ends, because every write must be delivered. After a reload, the stream continues
        if the register still exists.

        Statuses:
            NOT_FOUND: There is no such topic, or a reload has removed it.
            INVALID_ARGUMENT: The topic is a structure without a message type.
            RESOURCE_EXHAUSTED: The client is too slow for the writes or the steps.
        """
        if injection := await self._injecting.find(request.path, context):
            async for gift in self._injecting.given_values(injection, request.path, context):
                yield gift
            return
        if time_topic := await self._time_topic(request.path, context):
            async for moment in self._stream_time_topic(time_topic, context):
                yield moment
            return
        topic, found = await self._resolve(request.path, context)
        reported = False
        with self._outboxes.opened() as outbox:
            lane: Lane = StateLane(outbox)
            if topic.direction == "in":
                lane = EventLane(outbox, shorten(request.path))
            self._streams[outbox] = topic.source
            try:
                while True:
                    feed = self._topics.feed(topic.source)
                    encode = encoder(found, feed.block.layout)
                    joined = ExitStack()
                    joined.callback(lane.join(feed, Subject("v1", found.path, found.registers, encode)))
                    outbox.on_failure = joined.close  # at once, because a client that does not read delays the end
                    try:
                        if not reported:
                            await context.send_initial_metadata(())  # the client misses nothing from then on
                            reported = True
                        while (message := await outbox.pop()) is not None:
                            yield message
                    finally:
                        joined.close()
                    if outbox.failure:
                        await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)
                    found = await self._find_again(topic, context)
            finally:
                del self._streams[outbox]

    async def _stream_time_topic(self, time_topic: TimeTopic, context: Context) -> AsyncIterator[bytes]:
        """Stream the values of a time topic."""
        with self._outboxes.opened() as outbox, ExitStack() as listening:
            listening.callback(self._stepper.timeline.time_topics.listen(time_topic, _time_message, StateLane(outbox)))
            outbox.on_failure = listening.close
            await context.send_initial_metadata(())
            while (message := await outbox.pop()) is not None:
                yield message
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch the streams of these sources to their new feeds, after a reload."""
        for outbox, source in self._streams.items():
            if source in sources:
                outbox.end()

    async def _find_again(self, topic: Topic, context: Context) -> Shape:
        """Return the registers that a stream's topic names after a reload.

        Statuses:
            NOT_FOUND: The topic no longer exists.
        """
        try:
            return self._find(topic)
        except (PathError, ValueRangeError) as error:
            await context.abort(grpc.StatusCode.NOT_FOUND, str(error))
            raise  # abort never returns

    def _find(self, topic: Topic) -> Shape:
        """Return the registers that a topic names.

        Raises:
            PathError: There is no such register.
            ValueRangeError: The topic is a whole source, or a structure without a message type.

        """
        if not topic.path:
            raise ValueRangeError(f"{topic} is a whole source; version 1 serves only its registers")
        found = shape(self._topics.layout(topic), topic)
        message_type(found)
        return found

    async def publish(self, messages: AsyncIterator[bytes], context: Context) -> Empty:
        """Write the values of a stream in order. Answer when all outcomes are known."""
        return await self._publisher.publish(messages, _parse, context.peer())

    async def _time_topic(self, path: str, context: Context) -> TimeTopic | None:
        """Return the time topic that a path names, or None.

        Statuses:
            NOT_FOUND: There is no such source.
        """
        try:
            return self._topics.time_topic(path)
        except PathError as error:
            await refuse(context, error)

    async def _resolve(self, path: str, context: Context) -> tuple[Topic, Shape]:
        try:
            topic = self._topics.topic(path)
            return topic, self._find(topic)
        except ShmioError as error:
            await refuse(context, error)


def _parse(message: bytes) -> Request:
    request = wire.PubRequest.FromString(message)
    return Request(request.topic.path, partial(read, request.data))


def _time_message(time_topic: TimeTopic, moment: Moment) -> bytes:
    """Encode a value of a time topic.

    The simulation time is sent as the time stamp, with an empty value.
    """
    value = str(moment.number) if time_topic is TimeTopic.STEP else ""
    return wire.ROSMessage(type=_TIME_TOPIC_TYPES[time_topic], value=value).SerializeToString() + time_stamp(*moment)
