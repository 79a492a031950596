"""Serves SimlogAPI version 2, package ``simlog.server``, with values as ``google.protobuf.Value``.

A message is built by concatenating serialised fields, so the fields that all listeners share are
encoded once.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Final

import grpc
import numpy as np
from google.protobuf.empty_pb2 import Empty
from google.protobuf.struct_pb2 import NULL_VALUE, ListValue
from google.protobuf.struct_pb2 import Value as WireValue

from shmio.endpoints.grpc.encoding import BlockImage, Subject, delimited, unless_bad, varint
from shmio.endpoints.grpc.server.access import holder_of
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.server.limits import time_sliced
from shmio.endpoints.grpc.services.injection import Shadow, ShadowKind, Shadows, shadow_paths
from shmio.endpoints.grpc.services.publish import Publisher, Request
from shmio.endpoints.grpc.streams.feed import Moment
from shmio.endpoints.grpc.streams.outbox import EventLane, Finish, Lane, Outbox, Outboxes, StateLane
from shmio.endpoints.grpc.time.timeline import TimeTopics
from shmio.endpoints.grpc.topics import Shape, TimeTopic, Topics, shape
from shmio.errors import ConflictError, EndpointError, PathError, ShmioError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, decode_segment, encode_segment, shorten
from shmio.layout.values.codec import Value, codec, scalar_codec
from shmio.layout.values.text import from_text, wire_type
from shmio.logs import fields
from shmio.segment import EventKind, Frame, Quality
from shmio.wire import simlog_v2_pb2 as wire

SERVICE: Final = wire.DESCRIPTOR.services_by_name["SimlogAPI"].full_name
MAX_SUBSCRIBERS: Final = 256
MAX_TOPICS: Final = 10_000
"""Maximum number of topics of one subscriber."""
MAX_ALL_TOPICS: Final = 100_000
"""Maximum number of topics of all subscribers together."""
MAX_NAME: Final = 256
"""Maximum length of a subscriber's name and uuid, in characters."""
PATIENCE_S: Final = 1.0
"""Time in s for which Subscribe waits for CreateSubscriber, because the two calls may come in any order."""
MAX_ELEMENTS: Final = 1 << 16
"""Maximum number of numbers, bits and texts together in one value."""
MAX_MEMBERS: Final = 4096
"""Maximum number of registers in one structure."""
MAX_LEVELS: Final = 24
"""Maximum nesting depth of structures.

Each level of a structure needs three levels of messages, and protobuf's readers stop at 100 levels.
"""

_DOUBLE: Final = struct.Struct("<Bd")
_TYPES: Final = {"bool": wire.BOOL, "double": wire.NUMBER, "int": wire.NUMBER, "string": wire.STRING}

log = logging.getLogger("shmio.grpc")


class EncodedMessage:
    """A SimlogMessage without its path: the header's time stamp, and the fields after the header."""

    __slots__ = ("_last", "rest", "stamp")

    def __init__(self, stamp: bytes, rest: bytes) -> None:
        self.stamp = stamp
        self.rest = rest
        self._last: tuple[bytes | None, bytes] = None, b""

    def __len__(self) -> int:
        return len(self.stamp) + len(self.rest)

    def under(self, path: bytes) -> bytes:
        """Return the message for a path, which :func:`path_field` has encoded."""
        last, whole = self._last
        if last != path:  # most listeners use the same path
            header = self.stamp + path
            whole = b"\x0a" + varint(len(header)) + header + self.rest
            self._last = path, whole
        return whole


def value_type(found: Shape) -> wire.ValueType:
    """Return the type of a topic's values."""
    if not found.whole:
        return wire.STRUCT
    (register,) = found.registers
    return wire.LIST if register.dims else _TYPES[wire_type(register)]


def subject(found: Shape, layout: Layout) -> Subject:
    """Return the :class:`Subject` that a feed needs to deliver a topic.

    Raises:
        ValueRangeError: The topic is too large, or nested too deeply, for a message.

    """
    return Subject("v2", found.path, found.registers, encoder(found, layout))


def encoder(found: Shape, layout: Layout) -> Callable[[BlockImage], EncodedMessage | None]:
    """Return a function that encodes a topic as a message, from an image.

    The function returns None if the bytes are invalid, or if the source reports a register as bad.

    Raises:
        ValueRangeError: The topic is too large, or nested too deeply, for a message.

    """
    members, elements = len(found.registers), found.elements
    if members > MAX_MEMBERS or elements > MAX_ELEMENTS:
        raise ValueRangeError(
            f"{shorten(found.path)}: {members} registers with {elements} elements are too many for one value; "
            f"at most {MAX_MEMBERS} with {MAX_ELEMENTS} are allowed; use its members as topics"
        )
    head = wire.SimlogMessage(type=value_type(found)).SerializeToString() + b"\x1a"
    serialise = _whole(found.registers[0], layout) if found.whole else _structure(found, layout)

    def encode(picture: BlockImage) -> EncodedMessage | None:
        value = serialise(picture.image)
        return None if value is None else EncodedMessage(time_stamp(picture.clock_ns), head + delimited(value))

    return unless_bad(encode, found.registers, layout)


def path_field(path: str) -> bytes:
    """Encode the path as a field of a header."""
    return b"\x12" + delimited(path.encode())


@lru_cache(maxsize=64)  # a frame or two for each feed
def time_stamp(clock_ns: int) -> bytes:
    """Encode a time as a field of a header. ``clock_ns`` is in ns of the instance's clock."""
    seconds, nanos = divmod(clock_ns, 1_000_000_000)
    whole = b"\x08" + varint(seconds) if seconds else b""
    return b"\x0a" + delimited(whole + b"\x10" + varint(nanos) if nanos else whole)


def nothing(stamp: bytes) -> EncodedMessage:
    """Return the message for a missing value. ``stamp`` is its encoded time stamp."""
    return EncodedMessage(stamp, wire.SimlogMessage(type=wire.NULL, value=to_wire(None)).SerializeToString())


def time_message(topic: TimeTopic, moment: Moment) -> EncodedMessage:
    """Return the message of a time topic: the step's number, or the time in s."""
    value = moment.number if topic is TimeTopic.STEP else moment.clock_ns / 1e9
    message = wire.SimlogMessage(type=wire.NUMBER, value=to_wire(value))
    return EncodedMessage(time_stamp(moment.clock_ns), message.SerializeToString())


def repeated(messages: Iterable[bytes]) -> bytes:
    """Encode a protobuf message whose field 1 repeats these serialised messages."""
    return b"".join(b"\x0a" + delimited(message) for message in messages)


def to_wire(value: Value) -> WireValue:
    """Convert a decoded value. Numbers become doubles, and a missing value becomes NULL."""
    found = WireValue()
    _put(value, found)
    return found


def from_wire(value: WireValue, found: Shape) -> dict[str, object]:
    """Convert a client's value to values by register path. A structure need not have all its members.

    If a client sends a text for a register of another type, the text is parsed as in version 1. So
    a 64-bit number keeps all its digits.

    Raises:
        ValueRangeError: The value does not fit the topic.

    """
    if found.whole:
        (register,) = found.registers
        return {register.path: _read(value, register)}
    values: dict[str, object] = {}
    by_path = {register.path: register for register in found.registers}
    _read_members(value, found.path, by_path, values)
    if not values:
        raise ValueRangeError(f"{found.path}: expected a structure with some of its members, found none")
    return values


def _read_members(value: WireValue, path: str, by_path: Mapping[str, Register], values: dict[str, object]) -> None:
    """Collect the values of a structure, no deeper than the registers' paths."""
    if value.WhichOneof("kind") != "struct_value":
        raise ValueRangeError(f"{path}: expected a structure")
    for name, member in value.struct_value.fields.items():
        inner = f"{path}/{encode_segment(name)}"
        if inner in by_path:
            values[inner] = _read(member, by_path[inner])
        elif any(other.startswith(f"{inner}/") for other in by_path):
            _read_members(member, inner, by_path, values)
        else:
            raise ValueRangeError(f"{shorten(inner)}: the structure has no member {shorten(name)}")


def _read(value: WireValue, register: Register) -> object:
    kind = value.WhichOneof("kind")
    if kind == "string_value" and (register.dims or wire_type(register) != "string"):
        return from_text(value.string_value, register)
    return _plain(value, register.path)


def _plain(value: WireValue, name: str) -> object:
    kind = value.WhichOneof("kind")
    if kind == "list_value":
        return [_plain(item, name) for item in value.list_value.values]
    if kind in ("number_value", "bool_value", "string_value"):
        plain: object = getattr(value, kind)
        return plain
    raise ValueRangeError(f"{name}: expected a value, found {'a structure' if kind == 'struct_value' else 'none'}")


def _whole(register: Register, layout: Layout) -> Callable[[bytes], bytes | None]:
    """Return a function that encodes a register as a Value, or returns None for invalid bytes."""
    element, order = register.element, layout.byte_order
    code = "" if element.base == "BOOL" else scalar_codec(element, order).plain
    if code and len(register.dims) == 1:
        return _numbers(register, np.dtype(code).newbyteorder(order))
    decode = codec(register, order).decode
    if code and not register.dims:
        return lambda image: _DOUBLE.pack(0x11, decode(image))  # field 1 of a Value

    def serialise(image: bytes) -> bytes | None:
        value = decode(image)
        return None if value is None else to_wire(value).SerializeToString()

    return serialise


def _numbers(register: Register, kind: np.dtype[Any]) -> Callable[[bytes], bytes]:
    """Return a function that encodes an array of numbers as a Value.

    This is a hundred times as fast as encoding each number by itself.
    """
    one = ListValue(values=[WireValue(number_value=0)]).SerializeToString()  # ends with its double
    size = register.count * len(one)
    head = b"\x32" + varint(size)
    template = np.zeros(register.count, [("head", f"V{len(one) - 8}"), ("value", "<f8")])
    template["head"] = np.void(one[:-8])

    def serialise(image: bytes) -> bytes:
        values = template.copy()
        values["value"] = np.frombuffer(image, kind, register.count, register.offset)
        return head + values.tobytes()

    return serialise


def _structure(found: Shape, layout: Layout) -> Callable[[bytes], bytes]:
    """Return a function that encodes a structure as a Value.

    Raises:
        ValueRangeError: The structure is nested too deeply.

    """
    start = len(found.path) + 1
    fill = _members([(register.path[start:].split("/"), register) for register in found.registers], layout, MAX_LEVELS)

    def serialise(image: bytes) -> bytes:
        value = WireValue()
        fill(image, value)
        return value.SerializeToString(deterministic=True)  # equal values are equal bytes: maps have no order

    return serialise


def _members(
    parts: list[tuple[list[str], Register]], layout: Layout, levels: int
) -> Callable[[bytes, WireValue], None]:
    """Return a function that fills in a structure.

    Args:
        parts: Each register, with the names of its path below this structure.
        layout: The layout of the block.
        levels: How many levels of structures are still allowed.

    """
    if not levels:
        raise ValueRangeError(f"{shorten(parts[0][1].path)}: structures are nested in more than {MAX_LEVELS} levels")
    groups: dict[str, list[tuple[list[str], Register]]] = {}
    for (name, *rest), register in parts:
        groups.setdefault(decode_segment(name), []).append((rest, register))
    members: list[tuple[str, Callable[[bytes, WireValue], None]]] = []
    for name, inner in groups.items():
        rest, register = inner[0]
        members.append((name, _members(inner, layout, levels - 1) if rest else _member(register, layout)))

    def fill(image: bytes, value: WireValue) -> None:
        fields = value.struct_value.fields
        for name, put in members:
            put(image, fields[name])

    return fill


def _member(register: Register, layout: Layout) -> Callable[[bytes, WireValue], None]:
    decode = codec(register, layout.byte_order).decode
    return lambda image, value: _put(decode(image), value)


def _put(item: Value, value: WireValue) -> None:
    if isinstance(item, bool):
        value.bool_value = item
    elif isinstance(item, int | float):
        value.number_value = item
    elif isinstance(item, str):
        value.string_value = item
    elif item is None:
        value.null_value = NULL_VALUE
    else:
        values = value.list_value.values
        for inner in item:
            _put(inner, values.add())


@dataclass(slots=True)
class _Subscription:
    """A subscribed topic.

    ``topic`` is None for a shadow topic. ``leave`` ends the subscription; it is None while the
    topic does not exist.
    """

    topic: Topic | TimeTopic | None
    lane: Lane | None
    leave: Callable[[], None] | None = None


class Subscriber:
    """A CreateSubscriber call, with the topics that it streams."""

    def __init__(
        self, topics: Topics, shadows: Shadows, time_topics: TimeTopics, name: str, outbox: Outbox, holder: object
    ) -> None:
        """Create a subscriber without topics.

        Args:
            topics: Resolves paths.
            shadows: The shadow topics of all SimlogAPI clients.
            time_topics: The time topics.
            name: Name that the client has chosen, for the log.
            outbox: The outbox of the call's stream.
            holder: The client that owns the subscriber.

        """
        self.name = name
        self.outbox = outbox
        self.holder = holder
        self.replaced = False
        """True if a new call with the same uuid has replaced this one."""
        self._topics = topics
        self._shadows = shadows
        self._time_topics = time_topics
        self._subscriptions: dict[str, _Subscription] = {}

    def __len__(self) -> int:
        return len(self._subscriptions)

    def add(self, path: str) -> None:
        """Subscribe to a topic, unless the subscriber already has it.

        Raises:
            PathError: There is no such topic.
            ValueRangeError: The topic is too large for a message.

        """
        if path in self._subscriptions:
            return
        finish = partial(EncodedMessage.under, path=path_field(path))
        if shadow := self._shadows.find(path):
            self._subscriptions[path] = _Subscription(None, None, self._join_shadow(path, shadow, finish))
            return
        topic = self._topics.time_topic(path) or self._topics.topic(path)
        lane: Lane = StateLane(self.outbox, finish)
        if isinstance(topic, Topic) and topic.direction == "in":
            lane = EventLane(self.outbox, shorten(path), finish)
        subscription = _Subscription(topic, lane)
        self._join(subscription)
        self._subscriptions[path] = subscription

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch to the new feeds of these sources.

        If a topic no longer exists, its subscription waits until the topic exists again.
        """
        for path, subscription in self._subscriptions.items():
            if isinstance(subscription.topic, Topic) and subscription.topic.source in sources:
                self._leave(subscription)
                try:
                    self._join(subscription)
                except ShmioError as error:
                    log.info("a subscribed topic no longer exists: %s", error, extra=fields(topic=shorten(path)))

    def close(self) -> None:
        """Unsubscribe from all topics."""
        subscriptions, self._subscriptions = self._subscriptions, {}
        for subscription in subscriptions.values():
            self._leave(subscription)

    def _join_shadow(self, path: str, shadow: Shadow, finish: Finish) -> Callable[[], None]:
        """Listen to a shadow topic. Return the function that ends the subscription.

        While a stream listens to the originals, it keeps the injection alive.
        """
        injection, key = shadow.injection, object()
        to_message = encoder(injection.shape, injection.feed.block.layout)
        if shadow.kind is ShadowKind.ORIGINALS:
            leave = injection.originals("v2", to_message, self.outbox, shorten(path), finish)
            self._shadows.take_over(injection, key)
        else:
            leave = injection.given_values("v2", to_message, EventLane(self.outbox, shorten(path), finish))

        def over() -> None:
            log.info(
                "the injection behind a subscribed topic has ended: %s",
                injection.over,
                extra=fields(topic=shorten(path)),
            )
            self._leave(self._subscriptions.pop(path))

        def leave_it() -> None:
            injection.ends.pop(key, None)
            leave()
            self._shadows.release(injection, key)

        injection.ends[key] = over
        return leave_it

    def _join(self, subscription: _Subscription) -> None:
        topic, lane = subscription.topic, subscription.lane
        if topic is None or lane is None:
            return
        if isinstance(topic, TimeTopic):
            subscription.leave = self._time_topics.listen(topic, time_message, lane)
            return
        feed = self._topics.feed(topic.source)
        layout = feed.block.layout
        subscription.leave = lane.join(feed, subject(shape(layout, topic), layout))

    def _leave(self, subscription: _Subscription) -> None:
        if subscription.leave is not None:
            leave, subscription.leave = subscription.leave, None
            leave()


class Subscribers:
    """The subscribers with an open stream, by uuid."""

    def __init__(self, topics: Topics, shadows: Shadows, time_topics: TimeTopics) -> None:
        self._topics = topics
        self._shadows = shadows
        self._time_topics = time_topics
        self._open: dict[str, Subscriber] = {}
        self._arrived = asyncio.Event()

    def enter(self, uuid: str, name: str, outbox: Outbox, holder: object) -> Subscriber:
        """Add a subscriber for a new stream.

        If the same client already has a stream with this uuid, the old stream ends, because it may
        be left from a broken connection.

        Args:
            uuid: The subscriber's uuid.
            name: The subscriber's name.
            outbox: The new stream.
            holder: The client's identity.

        Raises:
            ValueRangeError: The uuid is missing or too long.
            ConflictError: Another client has the uuid.
            EndpointError: There are too many subscribers.

        """
        if not uuid:
            raise ValueRangeError("uuid: this field is needed, because Subscribe names the stream by it")
        if max(len(uuid), len(name)) > MAX_NAME:
            raise ValueRangeError(f"name and uuid must have at most {MAX_NAME} characters")
        before = self._open.get(uuid)
        if before is not None and before.holder != holder:
            raise ConflictError(f"uuid {shorten(uuid)!r} belongs to another client; choose a random one")
        if before is not None:
            del self._open[uuid]
            before.replaced = True
            before.close()
            before.outbox.clear()
            before.outbox.end()
            log.info("subscriber %s connected again; its earlier stream ends", shorten(name), extra=fields(uuid=uuid))
        elif len(self._open) >= MAX_SUBSCRIBERS:
            raise EndpointError(
                f"there are {MAX_SUBSCRIBERS} subscribers already, which is the maximum; one stream can serve "
                "many topics"
            )
        subscriber = self._open[uuid] = Subscriber(self._topics, self._shadows, self._time_topics, name, outbox, holder)
        self._arrived.set()
        self._arrived = asyncio.Event()
        return subscriber

    def leave(self, uuid: str, subscriber: Subscriber) -> None:
        """Remove a subscriber whose stream has ended."""
        subscriber.close()
        if self._open.get(uuid) is subscriber:
            del self._open[uuid]

    async def subscribe(self, uuid: str, path: str, holder: object) -> None:
        """Add a topic to a subscriber's stream. Wait up to ``PATIENCE_S`` for the stream to open.

        Args:
            uuid: The subscriber's uuid.
            path: The topic.
            holder: The client's identity.

        Raises:
            PathError: There is no such topic, or the client has no such subscriber.
            ValueRangeError: The topic is too large for a message.
            EndpointError: There are too many subscriptions.

        """
        with suppress(TimeoutError):
            async with asyncio.timeout(PATIENCE_S):
                while uuid not in self._open:
                    await self._arrived.wait()
        subscriber = self._open.get(uuid)
        if subscriber is None or subscriber.holder != holder:
            raise PathError(
                f"subscriberUUID {shorten(uuid)!r}: unknown subscriber; keep CreateSubscriber's stream open"
            )
        if len(subscriber) >= MAX_TOPICS or sum(map(len, self._open.values())) >= MAX_ALL_TOPICS:
            raise EndpointError(
                f"{shorten(path)}: too many subscriptions: at most {MAX_TOPICS} for each subscriber and "
                f"{MAX_ALL_TOPICS} in total are allowed"
            )
        subscriber.add(path)

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch all subscribers to the new feeds of these sources."""
        for subscriber in self._open.values():
            subscriber.on_sources_replaced(sources)


class SimlogV2:
    """Serves registers and structures of all sources as ``google.protobuf.Value``."""

    name = SERVICE

    def __init__(
        self, topics: Topics, publisher: Publisher, outboxes: Outboxes, shadows: Shadows, time_topics: TimeTopics
    ) -> None:
        self._topics = topics
        self._publisher = publisher
        self._outboxes = outboxes
        self._shadows = shadows
        self._subscribers = Subscribers(topics, shadows, time_topics)

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of the service's calls.

        The handlers of streams and of Read return serialised messages.
        """
        unary = grpc.unary_unary_rpc_method_handler
        empty = Empty.SerializeToString
        write = unary(self.write, wire.PubRequest.FromString, empty)
        calls: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "GetTopicInfo": unary(
                self.get_topic_info, wire.TopicInfoRequest.FromString, wire.TopicInfo.SerializeToString
            ),
            "CreateSubscriber": grpc.unary_stream_rpc_method_handler(
                self.create_subscriber, wire.Subscriber.FromString
            ),
            "Subscribe": unary(self.subscribe, wire.SubscriptionRequest.FromString, empty),
            "Inject": unary(self.inject, wire.InjectRequest.FromString, wire.InjectResponse.SerializeToString),
            "Publish": grpc.stream_unary_rpc_method_handler(self.publish, None, empty),
            "Write": write,
            "PublishSynch": write,
            "Read": unary(self.read, wire.ReadRequest.FromString),
        }
        return calls

    async def get_topic_info(self, request: wire.TopicInfoRequest, _: Context) -> wire.TopicInfo:
        """Describe a topic.

        For a topic that does not exist, the answer has only the path, and ``exists`` is False.
        """
        if shadow := self._shadows.find(request.path):
            kind = value_type(shadow.injection.shape)
            direction = wire.OUT if shadow.kind is ShadowKind.ORIGINALS else wire.IN
            return wire.TopicInfo(path=request.path, type=kind, direction=direction, exists=True)
        try:
            if self._topics.time_topic(request.path):
                return wire.TopicInfo(path=request.path, type=wire.NUMBER, direction=wire.OUT, exists=True)
            topic, found = self._find(request.path)
            direction = await self._direction(topic, found)
        except PathError:
            return wire.TopicInfo(path=request.path)
        return wire.TopicInfo(path=request.path, type=value_type(found), direction=direction, exists=True)

    async def create_subscriber(self, request: wire.Subscriber, context: Context) -> AsyncIterator[bytes]:
        """Stream the values of all topics that were subscribed to with this uuid, in frame order.

        Statuses:
            INVALID_ARGUMENT: The uuid is missing or too long.
            ALREADY_EXISTS: The uuid belongs to another client.
            RESOURCE_EXHAUSTED: There are too many subscribers, or this client is too slow for the
                writes or the steps.
            ABORTED: CreateSubscriber was called again with this uuid.
        """
        with self._outboxes.opened() as outbox:
            try:
                subscriber = self._subscribers.enter(request.uuid, request.name, outbox, _holder(context))
                outbox.on_failure = subscriber.close  # releases its injections at once
            except ShmioError as error:
                await refuse(context, error)
            try:
                await context.send_initial_metadata(())  # the client may subscribe from then on
                while (message := await outbox.pop()) is not None:
                    yield message
            finally:
                self._subscribers.leave(request.uuid, subscriber)
            if subscriber.replaced:
                await context.abort(grpc.StatusCode.ABORTED, "CreateSubscriber was called again with this uuid")
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)

    async def subscribe(self, request: wire.SubscriptionRequest, context: Context) -> Empty:
        """Add a topic to a subscriber's stream: its present value, if it is good, and its changes.

        For ``/in``, the stream gets the writes. For ``SIMLOG://step``, it gets the number of each
        step, after the values of that step.

        Statuses:
            NOT_FOUND: There is no such topic or subscriber.
            INVALID_ARGUMENT: The structure is too large for a message.
            RESOURCE_EXHAUSTED: There are too many subscriptions.
        """
        try:
            await self._subscribers.subscribe(request.subscriberUUID, request.path, _holder(context))
        except ShmioError as error:
            await refuse(context, error)
        return Empty()

    async def inject(self, request: wire.InjectRequest, context: Context) -> wire.InjectResponse:
        """Create an injection over a topic. Return the paths of its given values and its originals.

        The injection lasts while a subscriber is subscribed to ``shadowPathOut``. Before the first
        subscription, it lasts as long as the connection of this call.

        Statuses:
            NOT_FOUND: There is no such topic.
            INVALID_ARGUMENT: The structure is too large for a message, or the prefix is not usable.
            FAILED_PRECONDITION: The source refuses the injection; the message says why.
            RESOURCE_EXHAUSTED: There are too many injections.
        """
        try:
            topic, found = self._find(request.targetPath)
            encoder(found, self._topics.layout(topic))
            path_in, path_out = shadow_paths(request.shadowPathPrefix, topic)
            kinds = {path_in: ShadowKind.GIVEN, path_out: ShadowKind.ORIGINALS}
            await self._shadows.lay_for_client(topic, found, kinds, context.peer())
        except ShmioError as error:
            await refuse(context, error)
        return wire.InjectResponse(shadowPathIn=path_in, shadowPathOut=path_out)

    async def publish(self, messages: AsyncIterator[bytes], context: Context) -> Empty:
        """Write the values of a stream in order. Answer when all outcomes are known."""
        return await self._publisher.publish(messages, _parse, context.peer())

    async def write(self, request: wire.PubRequest, context: Context) -> Empty:
        """Write one value. Answer when its source has accepted it.

        Statuses:
            NOT_FOUND: There is no such topic.
            INVALID_ARGUMENT: The value does not fit the topic's type.
            FAILED_PRECONDITION: The topic is not writable, or the source does not accept the value.
            DEADLINE_EXCEEDED: The source did not answer; the value may have been written.
        """
        try:
            kind, reason = await self._publisher.write(_request(request), context.peer())
        except ShmioError as error:
            await refuse(context, error)
        if kind is EventKind.UNKNOWN:
            await context.abort(grpc.StatusCode.DEADLINE_EXCEEDED, f"{shorten(request.topic)}: {reason}")
        if kind is not EventKind.ACCEPTED:
            await context.abort(grpc.StatusCode.FAILED_PRECONDITION, f"{shorten(request.topic)}: {reason}")
        return Empty()

    async def read(self, request: wire.ReadRequest, context: Context) -> bytes:
        """Return the values of topics, in order. The values of one source come from one frame.

        A value with bad quality is returned as NULL.

        Statuses:
            NOT_FOUND: There is no such topic.
            INVALID_ARGUMENT: The values are too large for one message.
        """
        try:
            return repeated(await self._read(request.path))
        except ShmioError as error:
            await refuse(context, error)

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch the subscriptions of these sources to their new feeds, after a reload."""
        self._subscribers.on_sources_replaced(sources)

    def _find(self, path: str) -> tuple[Topic, Shape]:
        """Return the topic and the registers that a path names.

        Raises:
            PathError: There is no such topic.

        """
        topic = self._topics.topic(path)
        return topic, shape(self._topics.layout(topic), topic)

    async def _direction(self, topic: Topic, found: Shape) -> wire.DirectionType:
        if topic.direction is not None:
            return wire.IN if topic.direction == "in" else wire.OUT
        commands = self._topics.feed(topic.source).commands
        return wire.INOUT if await commands.writable(found.registers) else wire.OUT

    async def _read(self, paths: Iterable[str]) -> list[bytes]:
        """Return serialised messages. They are made in time slices, so that other tasks can run.

        Raises:
            PathError: There is no such topic.
            ValueRangeError: The values are too large for one message.

        """
        wanted: list[tuple[str, str | Shadow, Shape]] = []
        members = elements = 0
        async for path in time_sliced(paths):
            shadow = self._shadows.find(path)
            topic, found = (shadow.injection.target, shadow.injection.shape) if shadow else self._find(path)
            members, elements = members + len(found.registers), elements + found.elements
            if members > MAX_MEMBERS or elements > MAX_ELEMENTS:
                raise ValueRangeError(
                    f"{shorten(path)}: this is too much for one Read: at most {MAX_MEMBERS} registers with "
                    f"{MAX_ELEMENTS} elements are allowed"
                )
            wanted.append((path, shadow or topic.source, found))
        sources = {source for _, source, _ in wanted if isinstance(source, str)}
        frames = {source: self._topics.feed(source).block.latest() for source in sources}
        return [
            _shadow_message(path, source)
            if isinstance(source, Shadow)
            else self._message(path, source, found, frames[source])
            async for path, source, found in time_sliced(wanted)
        ]

    def _message(self, path: str, source: str, found: Shape, frame: Frame | None) -> bytes:
        block = self._topics.feed(source).block
        message = None
        if frame is not None and block.assess(frame)[0] is not Quality.BAD:
            message = encoder(found, block.layout)(frame)
        if message is None:
            message = nothing(time_stamp(frame.clock_ns) if frame else b"")
        return message.under(path_field(path))


def _holder(context: Context) -> object:
    """Return the identity of a call's client, which owns the uuids that the client chooses."""
    return holder_of(context.peer(), context.invocation_metadata() or (), context.auth_context())


def _shadow_message(path: str, shadow: Shadow) -> bytes:
    """Return the message of a shadow topic: the present original of ``/out``, otherwise NULL."""
    injection = shadow.injection
    shown = injection.present() if shadow.kind is ShadowKind.ORIGINALS else None
    message = None if shown is None else encoder(injection.shape, injection.feed.block.layout)(shown)
    return (message or nothing(b"")).under(path_field(path))


def _parse(message: bytes) -> Request:
    return _request(wire.PubRequest.FromString(message))


def _request(request: wire.PubRequest) -> Request:
    return Request(request.topic, partial(from_wire, request.data.value))
