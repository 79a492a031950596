"""Version 1's Inject, and the topics that its injections bring."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Any

import grpc

from shmio.endpoints.grpc.injection import Injection
from shmio.endpoints.grpc.outbox import EventLane, Outbox
from shmio.endpoints.grpc.outboxes import Outboxes
from shmio.endpoints.grpc.rosmessage import encoder, message_type
from shmio.endpoints.grpc.shadows import Shadows, Way, shadow_path
from shmio.endpoints.grpc.shape import Shape
from shmio.endpoints.grpc.status import refuse
from shmio.errors import ShmioError, ValueRangeError
from shmio.layout.topic import Topic, shorten
from shmio.wire import simlog_v1_pb2 as wire

Context = grpc.aio.ServicerContext[Any, Any]


class Injecting:
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
                ways = {shadow_path(request.injected.path): Way.GIFTS}
                injection = await self._shadows.lay(topic, found, ways, outbox, context.peer())
            except ShmioError as error:
                await refuse(context, error)
            release = partial(self._shadows.release, injection, outbox)
            outbox.on_failure = release  # at once, though a client that does not read holds up the stream's end
            try:
                encode = encoder(injection.shape, injection.feed.block.layout)
                leave = injection.originals("v1", encode, outbox, shorten(request.target.path))
                async for message in self._told(injection, outbox, leave, context):
                    yield message
            finally:
                release()
            await context.abort(grpc.StatusCode.ABORTED, f"{shorten(request.target.path)}: {injection.over}")

    async def gifts(self, injection: Injection, path: str, context: Context) -> AsyncIterator[bytes]:
        """Stream what is published to a shadow, as long as that stands."""
        with self._outboxes.opened() as outbox:
            encode = encoder(injection.shape, injection.feed.block.layout)
            leave = injection.gifts("v1", encode, EventLane(outbox, shorten(path)))
            async for message in self._told(injection, outbox, leave, context):
                yield message
            await context.abort(grpc.StatusCode.NOT_FOUND, f"{shorten(path)}: {injection.over}")

    async def _told(
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
