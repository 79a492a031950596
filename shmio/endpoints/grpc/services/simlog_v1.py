"""SimlogAPI version 1, package ``simulation.server``."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from contextlib import ExitStack
from functools import partial
from typing import Any, Final

import grpc
from google.protobuf.empty_pb2 import Empty

from shmio.endpoints.grpc.encoding import Subject
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.services.injection import Injection, ShadowKind, Shadows, shadow_path
from shmio.endpoints.grpc.services.publish import Publisher, Request
from shmio.endpoints.grpc.services.simlog_v1_values import encoder, message_type, read, time_stamp
from shmio.endpoints.grpc.streams.feed import Moment
from shmio.endpoints.grpc.streams.outbox import EventLane, Lane, Outbox, Outboxes, StateLane
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.topics import Shape, TimeTopic, Topics, shape
from shmio.errors import PathError, ShmioError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.logs import fields
from shmio.wire import simlog_v1_pb2 as wire


class InjectCalls:
    """The calls of version 1 about injections."""

    def __init__(
        self,
        outboxes: Outboxes,
        shadows: Shadows,
        resolve: Callable[[str, Context], Awaitable[tuple[Topic, Shape]]],
    ) -> None:
        """``resolve`` returns what a path names, or ends the call."""
        self._outboxes = outboxes
        self._shadows = shadows
        self._resolve = resolve

    async def find(self, path: str, context: Context) -> Injection | None:
        """Return the injection whose shadow a path is, or None.

        Status INVALID_ARGUMENT: it is over a structure without a message type.
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
        """Lay or join an injection while the stream is open, and stream its originals.

        Over ``/in`` the originals are the writes, which no longer reach the source. Over ``/out``,
        or without suffix, they are the source's values, the present one first. Values published to
        the shadow replace the originals.

        Statuses:
            NOT_FOUND: No such target.
            INVALID_ARGUMENT: A structure without a message type, or an unusable shadow path.
            ALREADY_EXISTS: The path is in use for another target.
            FAILED_PRECONDITION: The source refuses the injection; the message says why.
            RESOURCE_EXHAUSTED: Too many injections, or the client does not read the writes.
            ABORTED: The injection was lifted.
        """
        topic, found = await self._resolve(request.target.path, context)
        with self._outboxes.opened() as outbox:
            try:
                kinds = {shadow_path(request.injected.path): ShadowKind.GIVEN}
                injection = await self._shadows.lay(topic, found, kinds, outbox, context.peer())
            except ShmioError as error:
                await refuse(context, error)
            release = partial(self._shadows.release, injection, outbox)
            outbox.on_failure = release  # at once: a client that reads nothing delays the stream's end
            try:
                encode = encoder(injection.shape, injection.feed.block.layout)
                leave = injection.originals("v1", encode, outbox, shorten(request.target.path))
                async for message in self._messages(injection, outbox, leave, context):
                    yield message
            finally:
                release()
            await context.abort(grpc.StatusCode.ABORTED, f"{shorten(request.target.path)}: {injection.over}")

    async def given_values(self, injection: Injection, path: str, context: Context) -> AsyncIterator[bytes]:
        """Stream the values published to a shadow until its injection is over."""
        with self._outboxes.opened() as outbox:
            encode = encoder(injection.shape, injection.feed.block.layout)
            leave = injection.given_values("v1", encode, EventLane(outbox, shorten(path)))
            async for message in self._messages(injection, outbox, leave, context):
                yield message
            await context.abort(grpc.StatusCode.NOT_FOUND, f"{shorten(path)}: {injection.over}")

    async def _messages(
        self, injection: Injection, outbox: Outbox, leave: Callable[[], None], context: Context
    ) -> AsyncIterator[bytes]:
        """Stream an outbox until the injection is over.

        Status RESOURCE_EXHAUSTED: the client does not read.
        """
        injection.ends[outbox] = outbox.end
        if injection.over:
            outbox.end()
        try:
            await context.send_initial_metadata(())  # shows the client that the shadow stands
            while (message := await outbox.pop()) is not None:
                yield message
        finally:
            injection.ends.pop(outbox, None)
            leave()
        if outbox.failure:
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)


SERVICE: Final = wire.DESCRIPTOR.services_by_name["SimlogAPI"].full_name

_TIME_TOPIC_TYPES: Final = {TimeTopic.STEP: "int", TimeTopic.CLOCK: "time"}

log = logging.getLogger("shmio.grpc")


class SimlogV1:
    """Serves the registers of all sources as texts, and structures as their own messages."""

    name = SERVICE

    def __init__(
        self, topics: Topics, publisher: Publisher, outboxes: Outboxes, shadows: Shadows, stepper: Stepper
    ) -> None:
        self._topics = topics
        self._publisher = publisher
        self._outboxes = outboxes
        self._injecting = InjectCalls(outboxes, shadows, self._resolve)
        self._stepper = stepper
        self._streams: dict[Outbox, str] = {}  # with their sources

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
        """Set the step size, in ms, which makes time virtual.

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
        """Make a step after the values received from this client; answer when all streams have it.

        The code is 0, or -1 if the step failed; the log says why.
        """
        try:
            await self._stepper.step(peer=context.peer())
        except ShmioError as error:
            log.warning("step failed: %s", str(error), extra=fields(peer=context.peer()))
            return wire.StepResponse(code=-1)
        return wire.StepResponse(code=0)

    async def get_topic(self, request: wire.TopicDescriptor, context: Context) -> wire.TopicDescriptor:
        """Return a topic's type.

        Statuses:
            NOT_FOUND: No such topic.
            INVALID_ARGUMENT: A structure without a message type.
        """
        if injection := await self._injecting.find(request.path, context):
            return wire.TopicDescriptor(path=request.path, msgType=message_type(injection.shape))
        if time_topic := await self._time_topic(request.path, context):
            return wire.TopicDescriptor(path=request.path, msgType=_TIME_TOPIC_TYPES[time_topic])
        _, found = await self._resolve(request.path, context)
        return wire.TopicDescriptor(path=request.path, msgType=message_type(found))

    async def subscribe(self, request: wire.TopicDescriptor, context: Context) -> AsyncIterator[bytes]:
        """Stream a topic's current value, if it is good, and its changes; of ``/in``, the writes.

        Nothing is sent while quality is bad; on recovery the value is sent again. For a slow client
        the newest value replaces those that wait. Its stream of ``/in`` ends instead, because no
        write replaces another. After a reload the stream goes on if the register still exists.

        Statuses:
            NOT_FOUND: No such topic, or a reload has removed it.
            INVALID_ARGUMENT: A structure without a message type.
            RESOURCE_EXHAUSTED: The client is too slow for writes or steps.
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
        told = False
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
                    outbox.on_failure = joined.close  # at once: a client that reads nothing delays the end
                    try:
                        if not told:
                            await context.send_initial_metadata(())  # the client misses nothing from then on
                            told = True
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
        """Stream the values of a topic of time."""
        with self._outboxes.opened() as outbox, ExitStack() as listening:
            listening.callback(self._stepper.timeline.time_topics.listen(time_topic, _time_message, StateLane(outbox)))
            outbox.on_failure = listening.close
            await context.send_initial_metadata(())
            while (message := await outbox.pop()) is not None:
                yield message
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)

    def move(self, sources: Collection[str]) -> None:
        """Switch the streams of these sources to their present feeds, after a reload."""
        for outbox, source in self._streams.items():
            if source in sources:
                outbox.end()

    async def _find_again(self, topic: Topic, context: Context) -> Shape:
        """Return what a stream's topic names after a reload. Status NOT_FOUND: nothing."""
        try:
            return self._find(topic)
        except (PathError, ValueRangeError) as error:
            await context.abort(grpc.StatusCode.NOT_FOUND, str(error))
            raise  # abort never returns

    def _find(self, topic: Topic) -> Shape:
        """Return what a topic names.

        Raises:
            PathError: Nothing.
            ValueRangeError: A structure without a message type, or a whole source.

        """
        if not topic.path:
            raise ValueRangeError(f"{topic}: a source; version 1 serves only its registers")
        found = shape(self._topics.layout(topic), topic)
        message_type(found)
        return found

    async def publish(self, messages: AsyncIterator[bytes], context: Context) -> Empty:
        """Write a stream's values in order; answer when it and all its values have ended."""
        return await self._publisher.publish(messages, _parse, context.peer())

    async def _time_topic(self, path: str, context: Context) -> TimeTopic | None:
        """Return the topic of time that a path names, or None. Status NOT_FOUND: no such source."""
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
    """Encode a topic of time; the simulation time is in the time stamp, with an empty value."""
    value = str(moment.number) if time_topic is TimeTopic.STEP else ""
    return wire.ROSMessage(type=_TIME_TOPIC_TYPES[time_topic], value=value).SerializeToString() + time_stamp(*moment)
