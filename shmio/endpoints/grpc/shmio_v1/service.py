"""The service ``shmio.v1.Shmio`` (docs/reference/shmio-v1.md)."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection, Iterator, Mapping
from typing import Any, Final

import grpc

from shmio.endpoints.grpc.encoding import field, number
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.shmio_v1.clock import TimeCalls, clock
from shmio.endpoints.grpc.shmio_v1.events import EventCalls
from shmio.endpoints.grpc.shmio_v1.injections import InjectionCalls
from shmio.endpoints.grpc.shmio_v1.replay import ReplayCalls
from shmio.endpoints.grpc.shmio_v1.selection import Selections
from shmio.endpoints.grpc.shmio_v1.simulate import SimulateCalls
from shmio.endpoints.grpc.shmio_v1.snapshots import SnapshotCalls
from shmio.endpoints.grpc.shmio_v1.subscribe import SubscribeCalls
from shmio.endpoints.grpc.shmio_v1.tables import AGE_NS, ORIGINALS, Selection, View, describe, stale_fields
from shmio.endpoints.grpc.shmio_v1.write import WriteCalls
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import OpenStreams
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.endpoints.grpc.topics import Topics
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.errors import ShmioError
from shmio.local.status import ProcessStatus, SourceStatus, status_of
from shmio.segment import Block, Segment
from shmio.wire import shmio_v1_pb2 as wire

SERVICE: Final = wire.DESCRIPTOR.services_by_name["Shmio"].full_name
PART_REGISTERS: Final = 4096
"""Maximum number of registers in one message."""
_REMEDY: Final = "shmio-supervisor up takes them over, shmio-supervisor down stops them"


class ShmioV1:
    """Serves the registers of all sources: typed, and packed by type."""

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
        """Create the service.

        Args:
            topics: Resolves paths.
            feeds: The feeds of all sources, by name.
            wake_ups: The wake-ups that the feeds use.
            segment: The instance's shared memory.
            stepper: Controls the instance's time.
            open_streams: Counts the open streams of all services together.

        """
        self._topics = topics
        self._segment = segment
        self._selections = Selections(topics)
        self.subscribe_calls = SubscribeCalls(self._selections, wake_ups, stepper.timeline, open_streams)
        self._simulate_calls = SimulateCalls(feeds, segment)
        self._event_calls = EventCalls(feeds, wake_ups, segment)
        self._calls = (
            self.subscribe_calls,
            WriteCalls(topics),
            InjectionCalls(topics, feeds, self._selections, wake_ups),
            self._event_calls,
            self._simulate_calls,
            TimeCalls(segment, stepper),
            ReplayCalls(segment),
            SnapshotCalls(segment, stepper),
        )

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of the service's calls.

        Most handlers return serialised messages.
        """
        unary, streaming = grpc.unary_unary_rpc_method_handler, grpc.unary_stream_rpc_method_handler
        calls: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "GetLayouts": streaming(
                self.get_layouts, wire.GetLayoutsRequest.FromString, wire.LayoutPart.SerializeToString
            ),
            "GetStatus": unary(self.get_status, wire.GetStatusRequest.FromString, wire.Status.SerializeToString),
            "Read": unary(self.read, wire.ReadRequest.FromString),
        }
        for part in self._calls:
            calls |= part.handlers()
        return calls

    async def get_layouts(self, request: wire.GetLayoutsRequest, context: Context) -> AsyncIterator[wire.LayoutPart]:
        """Stream the layouts of the requested sources; of all sources if the request names none.

        Statuses:
            NOT_FOUND: There is no such source.
        """
        try:
            blocks = self._topics.blocks(request.sources)
        except ShmioError as error:
            await refuse(context, error)
        for block in blocks:
            for part in _layout_parts(block):
                yield part

    async def get_status(self, _: wire.GetStatusRequest, __: Context) -> wire.Status:
        """Return the information that ``shmio-supervisor status --json`` prints."""
        return _status(self._segment)

    async def read(self, request: wire.ReadRequest, context: Context) -> bytes:
        """Return the present values. The values of one source come from one frame.

        Statuses:
            NOT_FOUND: There is no such register.
            INVALID_ARGUMENT: There are too many registers.
            RESOURCE_EXHAUSTED: All clients together use too many registers.
        """
        try:
            views = await self._selections.select(self._selections.resolve(request.patterns))
            known = set(request.tables)
            tables = [field(1, view.table) for view in views if view.number not in known]
            return b"".join(tables + [field(2, _reading(view, originals=request.originals)) for view in views])
        except ShmioError as error:
            await refuse(context, error)

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch the streams of these sources to their new blocks, after a reload."""
        self._simulate_calls.on_sources_replaced()
        self._event_calls.on_sources_replaced(sources)
        self.subscribe_calls.on_sources_replaced(sources)


def _reading(view: View, *, originals: bool) -> bytes:
    """Return a serialised ``Update`` of the newest frame."""
    frame = view.block.latest()
    if frame is None:
        return wire.Update(table=view.number, reason="no data yet", whole=True).SerializeToString()
    update = view.update(frame).whole
    quality, reason = view.block.assess(frame)
    if quality is not frame.quality:
        update += stale_fields(reason)
    if originals and isinstance(view, Selection) and frame.effective is not None and frame.source_ns:
        update += field(ORIGINALS, view.originals(frame))
    return update + number(AGE_NS, max(0, frame.age_ns(view.block.now_ns())))


def _layout_parts(block: Block) -> Iterator[wire.LayoutPart]:
    """Yield the layout of a block, in as many messages as necessary."""
    layout, attributes = block.layout, block.attributes
    for first in range(0, max(1, len(layout.registers)), PART_REGISTERS):
        part = wire.LayoutPart(
            source=block.source,
            section=block.section,
            name=layout.name,
            number=layout.number,
            size=layout.size,
            status_offset=layout.status_offset,
            big_endian=layout.byte_order == "big",
            hash=layout.hash,
            period_ns=block.period_ns,
            stale_ns=block.stale_ns,
            writable=attributes.writable,
            armed=attributes.armed,
            optimized=layout.optimized,
            last=first + PART_REGISTERS >= len(layout.registers),
        )
        for register in layout.registers[first : first + PART_REGISTERS]:
            found = part.registers.add()
            describe(register, found)
            found.comment, found.over = register.comment, register.over
            if register.initial is not None:
                found.initial = register.initial
        yield part


def _status(segment: Segment) -> wire.Status:
    """Convert the instance's status to a message."""
    now = status_of(segment, _REMEDY, asking="grpc")
    found = wire.Status(
        instance=now.instance or "",
        mode=now.mode or "",
        state=now.state,
        segment=now.segment or "",
        segment_bytes=now.segment_bytes,
        processes=map(_process, now.processes),
        note=now.note,
        clock=clock(segment.clock.read()),
    )
    if now.supervisor is not None:
        found.supervisor.pid, found.supervisor.uptime_s = now.supervisor.pid, now.supervisor.uptime_s
    return found


def _process(process: SourceStatus | ProcessStatus) -> wire.Process:
    found = wire.Process(
        name=process.name,
        kind=process.kind,
        pid=process.pid,
        state=process.state,
        restarts=process.restarts,
        uptime_s=process.uptime_s,
        note=process.note,
        counters=process.counters,
    )
    if isinstance(process, SourceStatus):
        found.source.quality, found.source.reason = process.quality, process.reason
        found.source.rate_hz, found.source.overruns = process.rate_hz, process.overruns
        found.source.real_time = process.real_time
        if process.cycle is not None:
            found.source.cycle = process.cycle
    return found
