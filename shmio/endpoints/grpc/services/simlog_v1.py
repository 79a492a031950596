"""SimlogAPI version 1, package ``simulation.server``."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from contextlib import ExitStack
from functools import partial
from typing import Any, Final

import grpc
from google.protobuf.empty_pb2 import Empty

from shmio.endpoints.grpc.commands.path_kind import Shape, shape
from shmio.endpoints.grpc.commands.publish import Publisher, Request
from shmio.endpoints.grpc.commands.topics import TimeTopic, Topics
from shmio.endpoints.grpc.injection.injection import Injection
from shmio.endpoints.grpc.injection.injections import ShadowKind, Shadows, shadow_path
from shmio.endpoints.grpc.services.error_status import Context, refuse
from shmio.endpoints.grpc.services.simlog_v1_values import encoder, message_type, read, time_stamp
from shmio.endpoints.grpc.streams.outbox import EventLane, Lane, Outbox, StateLane
from shmio.endpoints.grpc.streams.outboxes import Outboxes
from shmio.endpoints.grpc.streams.subject import Subject
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.time.virtual_time import Moment
from shmio.errors import PathError, ShmioError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.logs import fields
from shmio.wire import simlog_v1_pb2 as wire


class InjectCalls:
    """The part of version 1 that is about injections."""

    def __init__(
        self,
        outboxes: Outboxes,
        shadows: Shadows,
        resolve: Callable[[str, Context], Awaitable[tuple[Topic, Shape]]],
    ) -> None:
        """``resolve``: what a path names, or the call ends."""
        self._outboxes = outboxes
        self._shadows = shadows
        self._resolve = resolve

    async def find(self, path: str, context: Context) -> Injection | None:
        """The injection that a path is a shadow of; INVALID_ARGUMENT: of a structure that there is no message for."""
        shadow = self._shadows.find(path)
        if shadow is None:
            return None
        try:
            message_type(shadow.injection.shape)
        except ValueRangeError as error:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"{shorten(path)}: {error}")
        return shadow.injection

    async def inject(self, request: wire.InjectRequest, context: Context) -> AsyncIterator[bytes]:
        """Lay a shadow over a topic, or join those who have laid it, as long as the stream is open; its originals.

        Over ``/in``: what is written there, which no longer reaches the source. Over ``/out``, or with no suffix: what
        the source delivers, the present value first. What is published to the shadow goes where the original would.
        NOT_FOUND: no such target; INVALID_ARGUMENT: a structure, or no path for a shadow; ALREADY_EXISTS: that path is
        in use for another target; FAILED_PRECONDITION: the source refuses it, and says why; RESOURCE_EXHAUSTED: too
        many, or this client does not read what is written; ABORTED: it was lifted.
        """
        topic, found = await self._resolve(request.target.path, context)
        with self._outboxes.opened() as outbox:
            try:
                kinds = {shadow_path(request.injected.path): ShadowKind.GIVEN}
                injection = await self._shadows.lay(topic, found, kinds, outbox, context.peer())
            except ShmioError as error:
                await refuse(context, error)
            release = partial(self._shadows.release, injection, outbox)
            outbox.on_failure = release  # at once, though a client that does not read holds up the stream's end
            try:
                encode = encoder(injection.shape, injection.feed.block.layout)
                leave = injection.originals("v1", encode, outbox, shorten(request.target.path))
                async for message in self._messages(injection, outbox, leave, context):
                    yield message
            finally:
                release()
            await context.abort(grpc.StatusCode.ABORTED, f"{shorten(request.target.path)}: {injection.over}")

    async def given_values(self, injection: Injection, path: str, context: Context) -> AsyncIterator[bytes]:
        """Stream what is published to a shadow, as long as that stands."""
        with self._outboxes.opened() as outbox:
            encode = encoder(injection.shape, injection.feed.block.layout)
            leave = injection.given_values("v1", encode, EventLane(outbox, shorten(path)))
            async for message in self._messages(injection, outbox, leave, context):
                yield message
            await context.abort(grpc.StatusCode.NOT_FOUND, f"{shorten(path)}: {injection.over}")

    async def _messages(
        self, injection: Injection, outbox: Outbox, leave: Callable[[], None], context: Context
    ) -> AsyncIterator[bytes]:
        """What comes for a stream of an injection until that is over; RESOURCE_EXHAUSTED: it is not read."""
        injection.ends[outbox] = outbox.end
        if injection.over:
            outbox.end()
        try:
            await context.send_initial_metadata(())  # who waits for it knows that the shadow stands
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
    """Serves the registers of all sources as text values."""

    name = SERVICE

    def __init__(
        self, topics: Topics, publisher: Publisher, outboxes: Outboxes, shadows: Shadows, stepper: Stepper
    ) -> None:
        self._topics = topics
        self._publisher = publisher
        self._outboxes = outboxes
        self._injecting = InjectCalls(outboxes, shadows, self._resolve)
        self._stepper = stepper
        self._streams: dict[Outbox, str] = {}  # and their source

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """The service's calls, for a server."""
        unary = grpc.unary_unary_rpc_method_handler
        decode = wire.TopicDescriptor.FromString
        calls: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "setStepSize": unary(self.set_step_size, wire.StepSizeRequest.FromString, Empty.SerializeToString),
            "step": unary(self.step, wire.StepRequest.FromString, wire.StepResponse.SerializeToString),
            "GetTopic": unary(self.get_topic, decode, wire.TopicDescriptor.SerializeToString),
            # No serializer: a change is encoded once, by the feed, and its bytes go to every stream.
            "Subscribe": grpc.unary_stream_rpc_method_handler(self.subscribe, decode),
            "Inject": grpc.unary_stream_rpc_method_handler(self._injecting.inject, wire.InjectRequest.FromString),
            # No deserializer either: bytes that are no message must not end the stream.
            "Publish": grpc.stream_unary_rpc_method_handler(self.publish, None, Empty.SerializeToString),
        }
        return calls

    async def set_step_size(self, request: wire.StepSizeRequest, context: Context) -> Empty:
        """How far a step moves time, in ms; from now on only steps do.

        INVALID_ARGUMENT: no step goes so far; FAILED_PRECONDITION: time is another program's to move.
        """
        try:
            await self._stepper.set_step_size(request.step * 1_000_000)
        except ShmioError as error:
            await refuse(context, error)
        return Empty()

    async def step(self, _: wire.StepRequest, context: Context) -> wire.StepResponse:
        """Step, after all that has come on this client's Publish streams; 0 when all streams have taken the step.

        -1: it failed, the log says why.
        """
        try:
            await self._stepper.step(peer=context.peer())
        except ShmioError as error:
            log.warning("step failed: %s", str(error), extra=fields(peer=context.peer()))
            return wire.StepResponse(code=-1)
        return wire.StepResponse(code=0)

    async def get_topic(self, request: wire.TopicDescriptor, context: Context) -> wire.TopicDescriptor:
        """Tell a topic's type; NOT_FOUND, INVALID_ARGUMENT for a structure that there is no message for."""
        if injection := await self._injecting.find(request.path, context):
            return wire.TopicDescriptor(path=request.path, msgType=message_type(injection.shape))
        if time_topic := await self._time_topic(request.path, context):
            return wire.TopicDescriptor(path=request.path, msgType=_TIME_TOPIC_TYPES[time_topic])
        _, found = await self._resolve(request.path, context)
        return wire.TopicDescriptor(path=request.path, msgType=message_type(found))

    async def subscribe(self, request: wire.TopicDescriptor, context: Context) -> AsyncIterator[bytes]:
        """Stream a topic's values: the current one if it is good, then every change; of ``/in``, what is written to it.

        While quality is bad nothing is sent; on recovery the value is sent again. A slow client is
        given the newest value in place of those that wait; but its stream of ``/in``, where none replaces another, ends
        with RESOURCE_EXHAUSTED. When a reload changes the source the stream goes on, if there still is such a register;
        else it ends with NOT_FOUND.
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
                    outbox.on_failure = joined.close  # at once, though a client that does not read holds up the end
                    try:
                        if not told:
                            await context.send_initial_metadata(())  # who waits for it misses nothing from then on
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
        """Stream a topic of time."""
        with self._outboxes.opened() as outbox, ExitStack() as listening:
            listening.callback(self._stepper.timeline.time_topics.listen(time_topic, _time_message, StateLane(outbox)))
            outbox.on_failure = listening.close
            await context.send_initial_metadata(())
            while (message := await outbox.pop()) is not None:
                yield message
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, outbox.failure)

    def move(self, sources: Collection[str]) -> None:
        """Have the streams of these sources go over to the feeds that there are by now."""
        for outbox, source in self._streams.items():
            if source in sources:
                outbox.end()

    async def _find_again(self, topic: Topic, context: Context) -> Shape:
        """What a stream shows after a reload; NOT_FOUND."""
        try:
            return self._find(topic)
        except (PathError, ValueRangeError) as error:
            await context.abort(grpc.StatusCode.NOT_FOUND, str(error))
            raise  # abort never returns

    def _find(self, topic: Topic) -> Shape:
        """What a topic names; PathError, ValueRangeError: a structure that there is no message for."""
        if not topic.path:
            raise ValueRangeError(f"{topic}: a source; version 1 serves what is in it")
        found = shape(self._topics.layout(topic), topic)
        message_type(found)
        return found

    async def publish(self, messages: AsyncIterator[bytes], context: Context) -> Empty:
        """Write the values of a stream, in its order, and answer when it has ended and all of them have."""
        return await self._publisher.publish(messages, _parse, context.peer())

    async def _time_topic(self, path: str, context: Context) -> TimeTopic | None:
        """The topic of time that a path names; NOT_FOUND."""
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
    """The message of a topic of time; the clock has it where a client looks for it, and no value."""
    value = str(moment.number) if time_topic is TimeTopic.STEP else ""
    return wire.ROSMessage(type=_TIME_TOPIC_TYPES[time_topic], value=value).SerializeToString() + time_stamp(*moment)
