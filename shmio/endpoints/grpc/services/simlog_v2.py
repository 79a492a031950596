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

from shmio.endpoints.grpc.commands.path_kind import Shape, shape
from shmio.endpoints.grpc.commands.publish import Publisher, Request
from shmio.endpoints.grpc.commands.topics import TimeTopic, Topics
from shmio.endpoints.grpc.injection.injections import Shadow, ShadowKind, Shadows, shadow_paths
from shmio.endpoints.grpc.server.access import holder_of
from shmio.endpoints.grpc.server.time_slices import time_sliced
from shmio.endpoints.grpc.services.error_status import refuse
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
from shmio.endpoints.grpc.streams.outbox import EventLane, Finish, Lane, Outbox, StateLane
from shmio.endpoints.grpc.streams.outboxes import Outboxes
from shmio.endpoints.grpc.time.time_topics import TimeTopics
from shmio.errors import ConflictError, EndpointError, PathError, ShmioError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.logs import fields
from shmio.segment import EventKind, Frame, Quality
from shmio.wire import simlog_v2_pb2 as wire

MAX_SUBSCRIBERS: Final = 256
MAX_TOPICS: Final = 10_000
"""Of one subscriber."""
MAX_ALL_TOPICS: Final = 100_000
"""Of all subscribers."""
MAX_NAME: Final = 256
"""Characters of a subscriber's name, and of its uuid."""
PATIENCE_S: Final = 1.0
"""So long Subscribe waits for its subscriber: the two calls may arrive in any order."""

log = logging.getLogger("shmio.grpc")


@dataclass(slots=True)
class _Subscription:
    """``topic``: None of an injection's. ``leave``: None while no source has such a topic."""

    topic: Topic | TimeTopic | None
    lane: Lane | None
    leave: Callable[[], None] | None = None


class Subscriber:
    """One CreateSubscriber call."""

    def __init__(
        self, topics: Topics, shadows: Shadows, time_topics: TimeTopics, name: str, outbox: Outbox, holder: object
    ) -> None:
        """``holder``: whose it is."""
        self.name = name
        self.outbox = outbox
        self.holder = holder
        self.replaced = False
        """Whether another one of its uuid has taken its place."""
        self._topics = topics
        self._shadows = shadows
        self._time_topics = time_topics
        self._subscriptions: dict[str, _Subscription] = {}

    def __len__(self) -> int:
        return len(self._subscriptions)

    def add(self, path: str) -> None:
        """Subscribe to a topic; again, if it is already: nothing. PathError, ValueRangeError, EndpointError."""
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
        """Go over to the feeds that these sources have by now; a topic that is gone waits until it is back."""
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
        """Listen to a topic of an injection, which a listener to originals holds; how to leave again."""
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
    """Those whose stream is open, by their uuid."""

    def __init__(self, topics: Topics, shadows: Shadows, time_topics: TimeTopics) -> None:
        self._topics = topics
        self._shadows = shadows
        self._time_topics = time_topics
        self._open: dict[str, Subscriber] = {}
        self._arrived = asyncio.Event()

    def enter(self, uuid: str, name: str, outbox: Outbox, holder: object) -> Subscriber:
        """A stream opens. One of its holder's that has the uuid ends: it may be what a broken connection has left.

        ValueRangeError: no uuid, or too long; ConflictError: another holder has it; EndpointError: too many.
        """
        if not uuid:
            raise ValueRangeError("uuid: it is needed, to say in Subscribe whose stream the topic is for")
        if max(len(uuid), len(name)) > MAX_NAME:
            raise ValueRangeError(f"name and uuid have at most {MAX_NAME} characters")
        before = self._open.get(uuid)
        if before is not None and before.holder != holder:
            raise ConflictError(f"uuid {shorten(uuid)!r} is another client's: take one that is drawn by chance")
        if before is not None:
            del self._open[uuid]
            before.replaced = True
            before.close()
            before.outbox.clear()
            before.outbox.end()
            log.info("subscriber %s came again; its stream before ends", shorten(name), extra=fields(uuid=uuid))
        elif len(self._open) >= MAX_SUBSCRIBERS:
            raise EndpointError(f"there are {MAX_SUBSCRIBERS} subscribers already; one stream serves many topics")
        subscriber = self._open[uuid] = Subscriber(self._topics, self._shadows, self._time_topics, name, outbox, holder)
        self._arrived.set()
        self._arrived = asyncio.Event()
        return subscriber

    def leave(self, uuid: str, subscriber: Subscriber) -> None:
        """Its stream has ended."""
        subscriber.close()
        if self._open.get(uuid) is subscriber:
            del self._open[uuid]

    async def subscribe(self, uuid: str, path: str, holder: object) -> None:
        """Add a topic to a subscriber's stream, which may still be about to open, and is its holder's alone.

        PathError: no such topic, or subscriber; ValueRangeError: too much for a message; EndpointError: too many.
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
                f"{shorten(path)}: too many subscriptions: {MAX_TOPICS} a subscriber and {MAX_ALL_TOPICS} in all are "
                "the most"
            )
        subscriber.add(path)

    def move(self, sources: Collection[str]) -> None:
        """Have all go over to the feeds that these sources have by now."""
        for subscriber in self._open.values():
            subscriber.move(sources)


SERVICE: Final = wire.DESCRIPTOR.services_by_name["SimlogAPI"].full_name

Context = grpc.aio.ServicerContext[Any, Any]


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
        """The service's calls, for a server. Values are serialised where they are made, and once."""
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
        """Tell what a topic is; ``exists`` is false, and no more said, for what does not exist."""
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
        """Stream the values of all topics that are subscribed for this uuid, in the order of the frames.

        INVALID_ARGUMENT: no uuid; ALREADY_EXISTS: it is another client's; RESOURCE_EXHAUSTED: too many subscribers, or
        this one does not read what is written to ``/in``, or what a step has changed; ABORTED: it came with its uuid
        again.
        """
        with self._outboxes.opened() as outbox:
            try:
                subscriber = self._subscribers.enter(request.uuid, request.name, outbox, _holder(context))
                outbox.on_failure = subscriber.close  # what it holds goes at once
            except ShmioError as error:
                await refuse(context, error)
            try:
                await context.send_initial_metadata(())  # who waits for it may subscribe from then on
                while (message := await outbox.pop()) is not None:
                    yield message
            finally:
                self._subscribers.leave(request.uuid, subscriber)
            if subscriber.replaced:
                await context.abort(grpc.StatusCode.ABORTED, "CreateSubscriber was called again with this uuid")
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)

    async def subscribe(self, request: wire.SubscriptionRequest, context: Context) -> Empty:
        """Add a topic to a subscriber's stream: the current value if it is good, then every change.

        Of ``/in``, what is written to it; of ``SIMLOG://step`` each step, when all else of it has come. NOT_FOUND: no
        such topic, or subscriber; INVALID_ARGUMENT: a structure too large for a message; RESOURCE_EXHAUSTED: too many.
        """
        try:
            await self._subscribers.subscribe(request.subscriberUUID, request.path, _holder(context))
        except ShmioError as error:
            await refuse(context, error)
        return Empty()

    async def inject(self, request: wire.InjectRequest, context: Context) -> wire.InjectResponse:
        """Lay a shadow over a topic; where its originals come from and its values go to, as long as it stands.

        It stands as long as a subscriber has ``shadowPathOut``; until the first has, as long as the connection that
        this call came by. NOT_FOUND: no such topic; INVALID_ARGUMENT: a structure too large for a message, or no
        prefix; FAILED_PRECONDITION: the source refuses it, and says why; RESOURCE_EXHAUSTED: too many.
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
        """Write the values of a stream, in its order, and answer when it has ended and all of them have."""
        return await self._publisher.publish(messages, _parse, context.peer())

    async def write(self, request: wire.PubRequest, context: Context) -> Empty:
        """Write one value; return when its source has accepted it.

        NOT_FOUND: no such topic; INVALID_ARGUMENT: no value of its type; FAILED_PRECONDITION: not writable, or the
        source takes nothing; DEADLINE_EXCEEDED: the source did not say, it is not known whether it was written.
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
        """The values of topics, in the order of the paths, those of one source from one frame; NULL while it is bad.

        NOT_FOUND: no such topic; INVALID_ARGUMENT: too much for a message.
        """
        try:
            return repeated(await self._read(request.path))
        except ShmioError as error:
            await refuse(context, error)

    def move(self, sources: Collection[str]) -> None:
        """Have the subscriptions of these sources go over to the feeds that there are by now."""
        self._subscribers.move(sources)

    def _find(self, path: str) -> tuple[Topic, Shape]:
        """What a path names; PathError."""
        topic = self._topics.topic(path)
        return topic, shape(self._topics.layout(topic), topic)

    async def _direction(self, topic: Topic, found: Shape) -> wire.DirectionType:
        if topic.direction is not None:
            return wire.IN if topic.direction == "in" else wire.OUT
        commands = self._topics.feed(topic.source).commands
        return wire.INOUT if await commands.writable(found.registers) else wire.OUT

    async def _read(self, paths: Iterable[str]) -> list[bytes]:
        """Serialised messages, made in turns; PathError, ValueRangeError."""
        wanted: list[tuple[str, str | Shadow, Shape]] = []
        members = elements = 0
        async for path in time_sliced(paths):
            shadow = self._shadows.find(path)
            topic, found = (shadow.injection.target, shadow.injection.shape) if shadow else self._find(path)
            members, elements = members + len(found.registers), elements + found.elements
            if members > MAX_MEMBERS or elements > MAX_ELEMENTS:
                raise ValueRangeError(
                    f"{shorten(path)}: too much for one Read: {MAX_MEMBERS} registers with {MAX_ELEMENTS} elements are "
                    "the most"
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
    """Whose stream a call is about."""
    return holder_of(context.peer(), context.invocation_metadata() or (), context.auth_context())


def _shadow_message(path: str, shadow: Shadow) -> bytes:
    """The message of an injection's topic: the original of ``/out`` as of now; of what is written there is none."""
    injection = shadow.injection
    shown = injection.present() if shadow.kind is ShadowKind.ORIGINALS else None
    message = None if shown is None else encoder(injection.shape, injection.feed.block.layout)(shown)
    return (message or nothing(b"")).under(path_field(path))


def _parse(message: bytes) -> Request:
    return _request(wire.PubRequest.FromString(message))


def _request(request: wire.PubRequest) -> Request:
    return Request(request.topic, partial(from_wire, request.data.value))
