"""The service ``shmio.v1.Shmio`` (docs/reference/shmio-v1.md)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Collection, Mapping
from typing import Any, Final

import grpc

from shmio.endpoints.grpc.encoding import field, number
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.shmio_v1 import describe
from shmio.endpoints.grpc.shmio_v1.clock import TimeCalls
from shmio.endpoints.grpc.shmio_v1.commands import CommandCalls
from shmio.endpoints.grpc.shmio_v1.events import EventCalls
from shmio.endpoints.grpc.shmio_v1.replay import ReplayCalls
from shmio.endpoints.grpc.shmio_v1.selection import Selections
from shmio.endpoints.grpc.shmio_v1.simulate import SimulateCalls
from shmio.endpoints.grpc.shmio_v1.subscribe import SubscribeCall
from shmio.endpoints.grpc.shmio_v1.views import AGE_NS, ORIGINALS, Selection, View, stale_fields
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import OpenStreams
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.time.timeline import PATIENCE_S
from shmio.endpoints.grpc.topics import Topics
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.errors import EndpointError, ShmioError
from shmio.local.time_control import Step
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as wire

SERVICE: Final = wire.DESCRIPTOR.services_by_name["Shmio"].full_name
MAX_STREAMS: Final = 256
"""Bound of the open Subscribe calls."""


class ShmioV1:
    """Serves the registers of all sources, typed and packed."""

    name = SERVICE

    def __init__(
        self,
        topics: Topics,
        feeds: Mapping[str, Feed],
        wake_ups: WakeUps,
        segment: Segment,
        stepper: Stepper,
        open_streams: OpenStreams,
    ) -> None:
        """``open_streams`` counts these streams together with those of other services."""
        self._feeds = feeds
        self._segment = segment
        self._selections = Selections(topics)
        self._wake_ups = wake_ups
        self._time_calls = TimeCalls(segment, stepper)
        self._virtual_time = stepper.timeline.virtual_time
        self._open_streams = open_streams
        stepper.timeline.add_receiver(self)
        self._command_calls = CommandCalls(topics, feeds, self._selections, self._wake_ups)
        self._simulate_calls = SimulateCalls(feeds, segment)
        self._replay_calls = ReplayCalls(segment)
        self._event_calls = EventCalls(feeds, wake_ups, segment)
        self._open: set[SubscribeCall] = set()
        self._ended_updates = 0

    @property
    def streams(self) -> int:
        """Number of open Subscribe calls."""
        return len(self._open)

    @property
    def updates(self) -> int:
        """Number of updates sent by Subscribe calls since the start."""
        return self._ended_updates + sum(subscription.updates for subscription in self._open)

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of the service's calls. Values are serialised where they are made."""
        unary, streaming = grpc.unary_unary_rpc_method_handler, grpc.unary_stream_rpc_method_handler
        calls: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "GetLayouts": streaming(
                self.get_layouts, wire.GetLayoutsRequest.FromString, wire.LayoutPart.SerializeToString
            ),
            "GetStatus": unary(self.get_status, wire.GetStatusRequest.FromString, wire.Status.SerializeToString),
            "Read": unary(self.read, wire.ReadRequest.FromString),
            "Subscribe": streaming(self.subscribe, wire.SubscribeRequest.FromString),
        }
        for part in (
            self._command_calls,
            self._event_calls,
            self._simulate_calls,
            self._time_calls,
            self._replay_calls,
        ):
            calls |= part.handlers()
        return calls

    async def get_layouts(self, request: wire.GetLayoutsRequest, context: Context) -> AsyncIterator[wire.LayoutPart]:
        """Stream the layouts of these sources, or of all. Status NOT_FOUND: no such source."""
        try:
            blocks = self._command_calls.blocks(request.sources)
        except ShmioError as error:
            await refuse(context, error)
        for block in blocks:
            for part in describe.layout_parts(block):
                yield part

    async def get_status(self, _: wire.GetStatusRequest, __: Context) -> wire.Status:
        """Return what ``shmio-supervisor status --json`` prints."""
        return describe.status(self._segment)

    async def read(self, request: wire.ReadRequest, context: Context) -> bytes:
        """Return the present values; those of one source are from one frame.

        Statuses:
            NOT_FOUND: No such register.
            INVALID_ARGUMENT: Too many registers.
            RESOURCE_EXHAUSTED: Too many registers of all clients together.
        """
        try:
            views = await self._selections.select(self._selections.resolve(request.patterns))
            known = set(request.tables)
            tables = [field(1, view.table) for view in views if view.number not in known]
            return b"".join(tables + [field(2, _reading(view, originals=request.originals)) for view in views])
        except ShmioError as error:
            await refuse(context, error)

    async def subscribe(self, request: wire.SubscribeRequest, context: Context) -> AsyncIterator[bytes]:
        """Stream the present values, then their changes or every frame.

        Statuses:
            NOT_FOUND: No such register.
            INVALID_ARGUMENT: Too many registers, or options that are not valid.
            RESOURCE_EXHAUSTED: Too many streams, too many registers of all clients together, or
                the client is too slow for steps or writes.
        """
        try:
            if len(self._open) >= MAX_STREAMS:
                raise EndpointError(f"{MAX_STREAMS} calls of Subscribe are open, the maximum: one takes many patterns")
            subscription = SubscribeCall(self._selections, self._wake_ups, self._virtual_time, request)
        except ShmioError as error:
            await refuse(context, error)
        self._open.add(subscription)
        try:
            with self._open_streams.joined():
                yield await subscription.open()
                async for message in subscription.messages():
                    yield message
        except ShmioError as error:
            await refuse(context, error)
        finally:
            self._open.discard(subscription)
            self._ended_updates += subscription.updates
            subscription.close()

    async def deliver(self, step: Step) -> None:
        """Send a step's changes and its marker on all streams, and wait until they are sent."""
        marks = {subscription.mark(step): subscription for subscription in self._open}
        if marks:
            _, late = await asyncio.wait(marks, timeout=PATIENCE_S)
            for mark in late:
                marks[mark].give_up()

    def release(self) -> None:
        """Wake all streams to send values as they come, because time is real again."""
        for subscription in self._open:
            subscription.wake()

    def move(self, sources: Collection[str]) -> None:
        """Switch the streams of these sources to their present blocks, after a reload."""
        self._simulate_calls.move()
        self._event_calls.move(sources)
        for subscription in self._open:
            subscription.move(sources)


def _reading(view: View, *, originals: bool) -> bytes:
    """Return a serialised ``Update`` of the newest frame."""
    frame = view.block.latest()
    if frame is None:
        return wire.Update(table=view.number, reason="no data yet", whole=True).SerializeToString()
    update = b"".join(view.update(frame))
    quality, reason = view.block.assess(frame)
    if quality is not frame.quality:
        update += stale_fields(reason)
    if originals and isinstance(view, Selection) and frame.effective is not None and frame.source_ns:
        update += field(ORIGINALS, view.originals(frame))
    return update + number(AGE_NS, max(0, frame.age_ns(view.block.now_ns())))
