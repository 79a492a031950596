"""The calls of shmio.v1 that send commands: Write, Inject, Declare, ListInjections, Lift."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Collection, Coroutine, Mapping
from typing import Any, Final

import grpc

from shmio.endpoints.grpc.commands import command_client
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.shmio_v1 import describe
from shmio.endpoints.grpc.shmio_v1.declare import DeclareCall
from shmio.endpoints.grpc.shmio_v1.inject import InjectCall
from shmio.endpoints.grpc.shmio_v1.selection import Selections
from shmio.endpoints.grpc.shmio_v1.values import assigned, outcome
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.topics import Topics
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.errors import CommandError, EndpointError, PathError, ShmioError, ValueRangeError
from shmio.layout.topic import shorten
from shmio.segment import Block
from shmio.segment.standing_injections import StandingInjection
from shmio.wire import shmio_v1_pb2 as wire

MAX_INJECTIONS: Final = 256
"""Bound of the open Inject and Declare calls."""
MAX_TIMEOUT_MS: Final = 86_400_000


class CommandCalls:
    """The calls that send commands to sources, and those about injections."""

    def __init__(self, topics: Topics, feeds: Mapping[str, Feed], selections: Selections, wake_ups: WakeUps) -> None:
        self._topics = topics
        self._feeds = feeds
        self._selections = selections
        self._wake_ups = wake_ups
        self._open: set[InjectCall | DeclareCall] = set()
        self._turn = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of these calls, by name."""
        unary = grpc.unary_unary_rpc_method_handler
        return {
            "Write": unary(self.write, wire.WriteRequest.FromString, wire.WriteResponse.SerializeToString),
            "Inject": grpc.stream_stream_rpc_method_handler(self.inject, wire.InjectRequest.FromString),
            "Declare": grpc.unary_stream_rpc_method_handler(self.declare, wire.DeclareRequest.FromString),
            "ListInjections": unary(
                self.list_injections,
                wire.ListInjectionsRequest.FromString,
                wire.ListInjectionsResponse.SerializeToString,
            ),
            "Lift": unary(self.lift, wire.LiftRequest.FromString, wire.LiftResponse.SerializeToString),
            "LiftAll": unary(self.lift_all, wire.LiftAllRequest.FromString, wire.LiftResponse.SerializeToString),
        }

    async def write(self, request: wire.WriteRequest, context: Context) -> wire.WriteResponse:
        """Write registers of one source, all or none; return the outcome of each.

        After an error status nothing was sent.

        Statuses:
            NOT_FOUND: No such register.
            INVALID_ARGUMENT: A value does not fit, several sources, or too many values.
            FAILED_PRECONDITION: A register is not writable, or the source does not answer.
        """
        try:
            if request.timeout_ms > MAX_TIMEOUT_MS:
                raise ValueRangeError(f"timeout_ms: at most {MAX_TIMEOUT_MS}, a day")
            source, values = await assigned(request.values, self._topics)
            timeout_s = request.timeout_ms / 1000 or None
            commands = self._topics.feed(source).commands
            ends = await command_client.write(commands, values, timeout_s, until_accepted=request.until_accepted)
            return wire.WriteResponse(outcomes=[outcome(*end) for end in ends])
        except ShmioError as error:
            await refuse(context, error)

    async def inject(self, requests: AsyncIterator[wire.InjectRequest], context: Context) -> AsyncIterator[bytes]:
        """Lay an injection while the stream is open, or for good.

        Originals are streamed to the client, which streams other values back.

        Statuses:
            NOT_FOUND: No such register.
            INVALID_ARGUMENT: The injection is not valid, or does not cover a given value.
            FAILED_PRECONDITION: The source refuses the injection; the message says why.
            RESOURCE_EXHAUSTED: Too many streams.
            ABORTED: Another client lifted it, or this client does not read the originals.
        """
        opening: asyncio.Task[bytes] | None = None
        taking: asyncio.Task[None] | None = None
        try:
            injection = await self._injection(requests)
            opening = asyncio.get_running_loop().create_task(injection.open())
            yield await asyncio.shield(opening)
            taking = asyncio.get_running_loop().create_task(injection.take(requests))
            taking.add_done_callback(injection.taken)
            async for message in injection.messages():
                yield message
            taking.cancel()
            await asyncio.shield(self._spawn(self._close(injection, opening)))  # it is lifted before the stream ends
            opening = None
        except ShmioError as error:
            await refuse(context, error)
        finally:
            if taking is not None:
                taking.cancel()
            if opening is not None:
                self._spawn(self._close(injection, opening))
        if injection.failure is not None:
            await refuse(context, injection.failure)
        if injection.over:
            await context.abort(grpc.StatusCode.ABORTED, f"{injection.source}: {injection.over}")

    async def _injection(self, requests: AsyncIterator[wire.InjectRequest]) -> InjectCall:
        """Read the first message. Raises PathError, ValueRangeError or EndpointError."""
        self._check_room()
        async for request in requests:
            if request.WhichOneof("what") == "lay":
                injection = InjectCall(self._topics, self._selections, self._wake_ups, request.lay)
                self._open.add(injection)
                return injection
            break
        raise ValueRangeError("the first message of Inject lays an injection, all others give values")

    def _check_room(self) -> None:
        """Raise EndpointError if too many calls are open."""
        if len(self._open) >= MAX_INJECTIONS:
            raise EndpointError(f"{MAX_INJECTIONS} calls of Inject and Declare are open, the maximum")

    async def _close(self, one: InjectCall | DeclareCall, opening: asyncio.Task[bytes]) -> None:
        try:
            await asyncio.wait((opening,))
            if not opening.cancelled() and opening.exception() is None:
                await one.close()
        finally:
            self._open.discard(one)

    async def declare(self, request: wire.DeclareRequest, context: Context) -> AsyncIterator[bytes]:
        """Lay declared injections, all or none, while the stream is open or for good.

        The stream is the record of their events.

        Statuses:
            INVALID_ARGUMENT: A declaration is not valid; the message names the key.
            FAILED_PRECONDITION: A source refuses an injection; the message says why.
            RESOURCE_EXHAUSTED: Too many streams.
            ABORTED: The client does not read the record, or it would have a gap.
        """
        opening: asyncio.Task[bytes] | None = None
        try:
            self._check_room()
            campaign = DeclareCall(self._feeds, request, self._turn)
            self._open.add(campaign)
            opening = asyncio.get_running_loop().create_task(campaign.open())
            yield await asyncio.shield(opening)
            async for message in campaign.messages():
                yield message
        except ShmioError as error:
            await refuse(context, error)
        finally:
            if opening is not None:
                campaign.abandon()
                self._spawn(self._close(campaign, opening))
        if campaign.over:
            await context.abort(grpc.StatusCode.ABORTED, campaign.over)

    async def list_injections(
        self, request: wire.ListInjectionsRequest, context: Context
    ) -> wire.ListInjectionsResponse:
        """List the injections that stand. Status NOT_FOUND: no such source."""
        found = wire.ListInjectionsResponse()
        try:
            for block in self.blocks(request.sources):
                found.injections.extend(describe.injection(block, one) for one in block.standing.read())
        except ShmioError as error:
            await refuse(context, error)
        return found

    async def lift(self, request: wire.LiftRequest, context: Context) -> wire.LiftResponse:
        """Lift one injection.

        Statuses:
            NOT_FOUND: No such injection.
            FAILED_PRECONDITION: The source does not answer.
        """
        try:
            (block,) = self.blocks([request.source])
            standing = [one for one in block.standing.read() if one.number == request.number and not one.lifted]
            if not standing:
                raise PathError(f"{request.source}: there is no injection {request.number}; ListInjections lists them")
            lifted = await self._lift(block, standing[0])
            if lifted.failure:
                raise CommandError(f"{request.source}: {lifted.failure}")
            return wire.LiftResponse(lifted=[lifted])
        except ShmioError as error:
            await refuse(context, error)

    async def lift_all(self, request: wire.LiftAllRequest, context: Context) -> wire.LiftResponse:
        """Lift all injections at once; the answer says why one still stands.

        Status NOT_FOUND: no such source.
        """
        try:
            blocks = self.blocks(request.sources)
        except ShmioError as error:
            await refuse(context, error)
        standing = [(block, one) for block in blocks for one in block.standing.read() if not one.lifted]
        lifted = await asyncio.gather(*(self._lift(block, one) for block, one in standing))
        return wire.LiftResponse(lifted=lifted)

    async def _lift(self, block: Block, one: StandingInjection) -> wire.Lifted:
        failure = await command_client.lift(self._feeds[block.source].commands, one.number)
        return wire.Lifted(source=block.source, number=one.number, name=one.name, failure=failure)

    def blocks(self, sources: Collection[str]) -> list[Block]:
        """Return the blocks of these sources, or of all. PathError: no such source."""
        for source in sources:
            if source not in self._feeds:
                raise PathError(f"no source {shorten(source)!r}; there are: {', '.join(self._feeds)}")
        return [self._feeds[source].block for source in dict.fromkeys(sources) or self._feeds]

    def _spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task
