"""SimlogAPI version 2, package ``simlog.server``."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import grpc
from google.protobuf.empty_pb2 import Empty

from shmio.endpoints.grpc.server.access import holder_of
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.server.limits import time_sliced
from shmio.endpoints.grpc.services.injection import Shadow, ShadowKind, Shadows, shadow_paths
from shmio.endpoints.grpc.services.publish import Publisher, Request
from shmio.endpoints.grpc.services.simlog_v2_values import (
    MAX_ELEMENTS,
    MAX_MEMBERS,
    EncodedMessage,
    encoder,
    from_wire,
    nothing,
    path_field,
    repeated,
    subject,
    time_message,
    time_stamp,
    value_type,
)
from shmio.endpoints.grpc.streams.outbox import EventLane, Finish, Lane, Outbox, Outboxes, StateLane
from shmio.endpoints.grpc.time.timeline import TimeTopics
from shmio.endpoints.grpc.topics import Shape, TimeTopic, Topics, shape
from shmio.errors import ConflictError, EndpointError, PathError, ShmioError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.logs import fields
from shmio.segment import EventKind, Frame, Quality
from shmio.wire import simlog_v2_pb2 as wire

MAX_SUBSCRIBERS: Final = 256
MAX_TOPICS: Final = 10_000
"""Bound of one subscriber's topics."""
MAX_ALL_TOPICS: Final = 100_000
"""Bound of all subscribers' topics."""
MAX_NAME: Final = 256
"""Longest name and uuid of a subscriber, in characters."""
PATIENCE_S: Final = 1.0
"""How long Subscribe waits for its subscriber: the two calls may arrive in any order."""

log = logging.getLogger("shmio.grpc")


@dataclass(slots=True)
class _Subscription:
    """A subscribed topic. ``topic``: None for a shadow. ``leave``: None while it does not exist."""

    topic: Topic | TimeTopic | None
    lane: Lane | None
    leave: Callable[[], None] | None = None


class Subscriber:
    """A CreateSubscriber call with its topics."""

    def __init__(
        self, topics: Topics, shadows: Shadows, time_topics: TimeTopics, name: str, outbox: Outbox, holder: object
    ) -> None:
        """``holder`` is the client that owns the subscriber."""
        self.name = name
        self.outbox = outbox
        self.holder = holder
        self.replaced = False
        """Whether a new call with the same uuid has replaced this one."""
        self._topics = topics
        self._shadows = shadows
        self._time_topics = time_topics
        self._subscriptions: dict[str, _Subscription] = {}

    def __len__(self) -> int:
        return len(self._subscriptions)

    def add(self, path: str) -> None:
        """Subscribe to a topic, unless it is subscribed already.

        Raises:
            PathError: No such topic.
            ValueRangeError: Too large for a message.

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

    def move(self, sources: Collection[str]) -> None:
        """Switch to the sources' present feeds; topics that are gone wait until they are back."""
        for path, subscription in self._subscriptions.items():
            if isinstance(subscription.topic, Topic) and subscription.topic.source in sources:
                self._leave(subscription)
                try:
                    self._join(subscription)
                except ShmioError as error:
                    log.info("a subscribed topic is gone: %s", error, extra=fields(topic=shorten(path)))

    def close(self) -> None:
        """Leave all topics."""
        subscriptions, self._subscriptions = self._subscriptions, {}
        for subscription in subscriptions.values():
            self._leave(subscription)

    def _join_shadow(self, path: str, shadow: Shadow, finish: Finish) -> Callable[[], None]:
        """Listen to a shadow topic; return the function that leaves.

        A listener to originals holds the injection.
        """
        injection, key = shadow.injection, object()
        to_message = encoder(injection.shape, injection.feed.block.layout)
        if shadow.kind is ShadowKind.ORIGINALS:
            leave = injection.originals("v2", to_message, self.outbox, shorten(path), finish)
            self._shadows.hold(injection, key)
        else:
            leave = injection.given_values("v2", to_message, EventLane(self.outbox, shorten(path), finish))

        def over() -> None:
            log.info("a subscribed topic is gone: %s", injection.over, extra=fields(topic=shorten(path)))
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
        """Add a subscriber whose stream opens.

        The same holder's stream with this uuid ends: a broken connection may have left it.

        Raises:
            ValueRangeError: There is no uuid, or it is too long.
            ConflictError: Another holder has the uuid.
            EndpointError: There are too many subscribers.

        """
        if not uuid:
            raise ValueRangeError("uuid: this field is needed, because Subscribe names its stream by it")
        if max(len(uuid), len(name)) > MAX_NAME:
            raise ValueRangeError(f"name and uuid have at most {MAX_NAME} characters")
        before = self._open.get(uuid)
        if before is not None and before.holder != holder:
            raise ConflictError(f"uuid {shorten(uuid)!r} belongs to another client: choose a random one")
        if before is not None:
            del self._open[uuid]
            before.replaced = True
            before.close()
            before.outbox.clear()
            before.outbox.end()
            log.info("subscriber %s connected again; its earlier stream ends", shorten(name), extra=fields(uuid=uuid))
        elif len(self._open) >= MAX_SUBSCRIBERS:
            raise EndpointError(f"there are {MAX_SUBSCRIBERS} subscribers already; one stream serves many topics")
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
        """Add a topic to a subscriber's stream, waiting ``PATIENCE_S`` for it to open.

        Raises:
            PathError: No such topic, or the holder has no such subscriber.
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
                f"subscriberUUID {shorten(uuid)!r}: no such subscriber; keep the stream of CreateSubscriber open"
            )
        if len(subscriber) >= MAX_TOPICS or sum(map(len, self._open.values())) >= MAX_ALL_TOPICS:
            raise EndpointError(
                f"{shorten(path)}: too many subscriptions: at most {MAX_TOPICS} for each subscriber and "
                f"{MAX_ALL_TOPICS} in total are allowed"
            )
        subscriber.add(path)

    def move(self, sources: Collection[str]) -> None:
        """Switch all subscribers to the sources' present feeds."""
        for subscriber in self._open.values():
            subscriber.move(sources)


SERVICE: Final = wire.DESCRIPTOR.services_by_name["SimlogAPI"].full_name


class SimlogV2:
    """Serves the registers and structures of all sources as ``google.protobuf.Value``."""

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
        """Return the handlers of the service's calls. Values are serialised where they are made."""
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
        """Describe a topic; for one that does not exist, only ``exists`` is set, to false."""
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
        """Stream the values of all topics that are subscribed for this uuid, in frame order.

        Statuses:
            INVALID_ARGUMENT: No uuid, or it is too long.
            ALREADY_EXISTS: The uuid is another client's.
            RESOURCE_EXHAUSTED: Too many subscribers, or this one is too slow for writes or steps.
            ABORTED: CreateSubscriber was called again with this uuid.
        """
        with self._outboxes.opened() as outbox:
            try:
                subscriber = self._subscribers.enter(request.uuid, request.name, outbox, _holder(context))
                outbox.on_failure = subscriber.close  # releases what it holds at once
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
        """Add a topic to a subscriber's stream: its current value, if it is good, and its changes.

        For ``/in`` the stream has the writes, for ``SIMLOG://step`` each step after its values.

        Statuses:
            NOT_FOUND: No such topic or subscriber.
            INVALID_ARGUMENT: The structure is too large for a message.
            RESOURCE_EXHAUSTED: Too many subscriptions.
        """
        try:
            await self._subscribers.subscribe(request.subscriberUUID, request.path, _holder(context))
        except ShmioError as error:
            await refuse(context, error)
        return Empty()

    async def inject(self, request: wire.InjectRequest, context: Context) -> wire.InjectResponse:
        """Lay an injection over a topic; return the paths for its values and for its originals.

        The injection stands while a subscriber has ``shadowPathOut``; before the first one, while
        this call's connection stands.

        Statuses:
            NOT_FOUND: No such topic.
            INVALID_ARGUMENT: The structure is too large for a message, or the prefix is unusable.
            FAILED_PRECONDITION: The source refuses the injection; the message says why.
            RESOURCE_EXHAUSTED: Too many injections.
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
        """Write a stream's values in order; answer when it and all its values have ended."""
        return await self._publisher.publish(messages, _parse, context.peer())

    async def write(self, request: wire.PubRequest, context: Context) -> Empty:
        """Write one value; answer when its source has accepted it.

        Statuses:
            NOT_FOUND: No such topic.
            INVALID_ARGUMENT: The value does not fit the topic's type.
            FAILED_PRECONDITION: The topic is not writable, or the source does not take the value.
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
        """Return the values of topics, in order; those of one source are from one frame.

        A value is NULL while its quality is bad.

        Statuses:
            NOT_FOUND: No such topic.
            INVALID_ARGUMENT: Too much for a message.
        """
        try:
            return repeated(await self._read(request.path))
        except ShmioError as error:
            await refuse(context, error)

    def move(self, sources: Collection[str]) -> None:
        """Switch the subscriptions of these sources to their present feeds, after a reload."""
        self._subscribers.move(sources)

    def _find(self, path: str) -> tuple[Topic, Shape]:
        """Return what a path names. PathError: nothing."""
        topic = self._topics.topic(path)
        return topic, shape(self._topics.layout(topic), topic)

    async def _direction(self, topic: Topic, found: Shape) -> wire.DirectionType:
        if topic.direction is not None:
            return wire.IN if topic.direction == "in" else wire.OUT
        commands = self._topics.feed(topic.source).commands
        return wire.INOUT if await commands.writable(found.registers) else wire.OUT

    async def _read(self, paths: Iterable[str]) -> list[bytes]:
        """Return serialised messages, made in time slices; raises PathError and ValueRangeError."""
        wanted: list[tuple[str, str | Shadow, Shape]] = []
        members = elements = 0
        async for path in time_sliced(paths):
            shadow = self._shadows.find(path)
            topic, found = (shadow.injection.target, shadow.injection.shape) if shadow else self._find(path)
            members, elements = members + len(found.registers), elements + found.elements
            if members > MAX_MEMBERS or elements > MAX_ELEMENTS:
                raise ValueRangeError(
                    f"{shorten(path)}: too much for one Read: at most {MAX_MEMBERS} registers with "
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
    """Return the owner of the uuids that a call names."""
    return holder_of(context.peer(), context.invocation_metadata() or (), context.auth_context())


def _shadow_message(path: str, shadow: Shadow) -> bytes:
    """Return the message of a shadow topic: the present original of ``/out``, else NULL."""
    injection = shadow.injection
    shown = injection.present() if shadow.kind is ShadowKind.ORIGINALS else None
    message = None if shown is None else encoder(injection.shape, injection.feed.block.layout)(shown)
    return (message or nothing(b"")).under(path_field(path))


def _parse(message: bytes) -> Request:
    return _request(wire.PubRequest.FromString(message))


def _request(request: wire.PubRequest) -> Request:
    return Request(request.topic, partial(from_wire, request.data.value))
