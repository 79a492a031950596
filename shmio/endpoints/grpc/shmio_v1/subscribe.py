"""The call Subscribe, which streams updates from any number of blocks."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Iterator
from functools import partial
from typing import Any, Final, Protocol

import grpc

from shmio.endpoints.grpc.commands.command_client import CommandClient
from shmio.endpoints.grpc.encoding import field, number
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.shmio_v1.selection import Selections, SourceDirection
from shmio.endpoints.grpc.shmio_v1.tables import (
    MISSED,
    DecodedImage,
    Selection,
    UpdateMessage,
    View,
    WriteUpdates,
    head,
    stale_fields,
)
from shmio.endpoints.grpc.streams.feed import VirtualTime
from shmio.endpoints.grpc.streams.outbox import OpenStreams, SendQueue, StepStream
from shmio.endpoints.grpc.time.timeline import Timeline
from shmio.endpoints.grpc.wakeups import Callback, WakeUps
from shmio.errors import EndpointError, PathError, SegmentError, ShmioError, ValueRangeError
from shmio.local.time_control import Step
from shmio.segment import Block, Event, Frame, FrameFollower
from shmio.wire import shmio_v1_pb2 as wire

MAX_STREAMS: Final = 256
"""Maximum number of open Subscribe calls."""
BATCH_BYTES: Final = 1 << 18
"""Size in bytes at which a message with updates is complete and is sent."""
BATCH_UPDATES: Final = 256
"""Maximum number of updates in one message.

Making this many updates takes some milliseconds. Then other tasks must run.
"""
MAX_RATE_HZ: Final = 1e6

TABLES, UPDATES, ENDED, STEP = (
    wire.SubscribeResponse.DESCRIPTOR.fields_by_name[name].number for name in ("tables", "updates", "ended", "step")
)


def check(request: wire.SubscribeRequest) -> None:
    """Check the options of a request.

    Raises:
        ValueRangeError: An option is not valid, or options exclude each other.
    """
    if request.mode not in wire.Mode.values() or request.format not in wire.Format.values():
        raise ValueRangeError(
            f"mode {request.mode}, format {request.format}: this version supports only 0 and 1 for each"
        )
    for name, value, most in (
        ("max_rate_hz", request.max_rate_hz, MAX_RATE_HZ),
        ("deadband", request.deadband, math.inf),
    ):
        if not 0 <= value <= most or math.isinf(value):
            raise ValueRangeError(
                f"{name}: {value} is not a number from 0 on{'' if math.isinf(most) else f', at most {most:g}'}"
            )
    if request.mode == wire.MODE_EVERY_FRAME and (request.max_rate_hz or request.deadband):
        raise ValueRangeError("max_rate_hz and deadband are allowed only in the mode LATEST")
    if request.format == wire.FORMAT_FRAMES and request.deadband:
        raise ValueRangeError("deadband is allowed only with the format VALUES")


class BlockUpdates(Protocol):
    """Makes the updates of one block for one subscriber. The ring in shared memory is the subscriber's queue."""

    view: View
    follower: FrameFollower
    due_s: float
    """Event loop time of the next possible update, in s; infinite if only a new frame makes an update possible."""

    def next(self, now_s: float) -> bytes | None:
        """Return the next serialised ``Update``; None if there is none yet."""


class EveryFrame:
    """Makes an update of every frame, beginning with the present frame, and counts overwritten frames."""

    due_s = math.inf

    def __init__(self, view: View) -> None:
        self.view = view
        self.follower = FrameFollower(view.block)

    def next(self, now_s: float) -> bytes | None:  # noqa: ARG002  there is no rate limit
        """Return the update of the next frame, or an update which reports that the last frame is now stale.

        Return None if there is neither.
        """
        follower = self.follower
        frame = follower.poll()
        if frame is None:
            return _stale_update(self.view, follower)
        update = self.view.update(frame, follower.frame).whole
        if missed := follower.take_missed():
            update += number(MISSED, missed)
        follower.take(frame, aged=not follower.behind)
        return update + stale_fields(follower.reason) if follower.stale else update


class LatestFrame:
    """Makes an update of the newest frame if it has changes; at most one update per interval."""

    def __init__(self, view: View, interval_s: float, deadband: float) -> None:
        self.view = view
        self.follower = FrameFollower(view.block)
        self.due_s = math.inf
        self._interval_s = interval_s
        self._deadband = deadband
        self._last_s = -math.inf
        self._values: DecodedImage | None = None  # the receiver's values; kept only with a dead-band
        self._with_statuses = view.block.statuses is not None
        self._sent: Frame | None = None  # frame of the last update; kept only if registers have statuses

    def next(self, now_s: float) -> bytes | None:
        """Return the changes in the newest frame, or an update which reports that the last frame is now stale.

        Return None if there is neither, or if the interval has not ended.
        """
        follower = self.follower
        shown = follower.frame
        if shown is not None and not follower.behind:
            return _stale_update(self.view, follower)
        if now_s < self._last_s + self._interval_s:
            self.due_s = self._last_s + self._interval_s
            return None
        self.due_s = math.inf
        try:
            frame = follower.newest()
        except SegmentError:  # overwritten during each attempt to read it; a newer frame will come
            return None
        if frame is None:
            return None
        update = self._update(frame, shown)
        was_stale = follower.stale
        follower.take(frame)
        stale = stale_fields(follower.reason) if follower.stale else b""
        if shown is not None and not (update.changed or stale or was_stale or _state(frame) != _state(shown)):
            return None
        self._last_s = now_s
        if self._with_statuses:
            self._sent = frame
        return update.whole + stale

    def _update(self, frame: Frame, shown: Frame | None) -> UpdateMessage:
        if not (self._deadband and isinstance(self.view, Selection)):
            return self.view.update(frame, shown, self._sent)
        if shown is None or self._values is None or not shown.source_ns:
            self._values = self.view.decode(frame)
            return self.view.update(frame)
        sent = self._sent or shown
        update, self._values = self.view.update_beyond(frame, shown, sent, self._values, self._deadband)
        return update


def _stale_update(view: View, follower: FrameFollower) -> bytes | None:
    """Return an update if the last frame has become stale since it was sent, otherwise None."""
    frame = follower.frame
    if frame is None or not follower.became_stale():
        return None
    return head(view.number, frame) + stale_fields(follower.reason)


def _state(frame: Frame) -> tuple[object, ...]:
    return frame.quality, frame.reason, frame.provenance, frame.incarnation


class WriteFollower:
    """Follows the writes to a table for one subscriber. Its queue drops no write."""

    def __init__(self, writes: WriteUpdates, commands: CommandClient, ring: Callable[[], None]) -> None:
        """Start following the writes.

        Args:
            writes: Encodes the writes.
            commands: The client of the source.
            ring: Called when there is an update.

        """
        self.failure = ""
        """Why writes are missing; empty if none are."""
        self._writes = writes
        self._commands = commands
        self._ring = ring
        self._waiting = SendQueue()
        commands.followers.listen(self)

    def leave(self) -> None:
        """Stop following writes."""
        self._commands.followers.leave(self)

    @property
    def waits(self) -> bool:
        """True if an update waits in the queue."""
        return bool(self._waiting)

    def next(self) -> bytes | None:
        """Return the next serialised ``Update``; None if there is none yet."""
        return self._waiting.pop() if self._waiting else None

    def accept(self, event: Event) -> None:
        """Queue a part of a command that the source has accepted."""
        if not self.failure and (update := self._writes.of(event)):
            if reason := self._waiting.add(update):
                self.fail(reason)
            self._ring()

    def fail(self, reason: str) -> None:
        """Discard the queue and stop following, because writes are missing."""
        self.failure = self.failure or reason
        self._waiting = SendQueue()
        self.leave()
        self._ring()


class SubscribeCall:
    """A Subscribe call: follows its blocks, and collects their updates."""

    def __init__(
        self, selections: Selections, wake_ups: WakeUps, virtual_time: VirtualTime, request: wire.SubscribeRequest
    ) -> None:
        """Check the request.

        Raises:
            PathError: There is no such source.
            ValueRangeError: An option is not valid, or there are too many patterns.

        """
        check(request)
        self.updates = 0
        self.late = False
        """True if a step has waited too long for the client; see :meth:`give_up`."""
        self._virtual_time = virtual_time
        self._opened = False
        self.on_taken: Callable[[StepStream], object] | None = None
        self._step: Step | None = None  # the step whose marker waits
        self._selections = selections
        self._wake_ups = wake_ups
        self._request = request
        self._wanted = selections.resolve(request.patterns, inward=True)
        if request.format == wire.FORMAT_FRAMES and any(place.inward for place in self._wanted):
            raise ValueRangeError("written values have no raw frames; leave out /in, or choose the format VALUES")
        self._blocks: dict[SourceDirection, BlockUpdates] = {}
        self._inward: dict[SourceDirection, WriteFollower] = {}
        self._rings: dict[SourceDirection, Callback] = {}  # the blocks' wake-up callbacks
        self._moved: dict[SourceDirection, None] = {}
        self._rotation = 0
        self._wake = asyncio.Event()
        self._clock = asyncio.get_running_loop().time

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks that the client reads frame by frame, each with the number of the last frame sent.

        A block whose frames wait for a step is left out.
        """
        for updates in self._blocks.values():
            if isinstance(updates, EveryFrame) and self._may_send(updates):
                yield updates.view.block, updates.follower.last

    async def open(self) -> bytes:
        """Start following all blocks, and return the serialised tables.

        Raises:
            PathError: There is no such register.
            ValueRangeError: This call uses too many registers or elements.
            EndpointError: All clients together use too many elements.

        """
        views = await self._selections.select(self._wanted, frames=self._request.format == wire.FORMAT_FRAMES)
        self._opened = True
        return b"".join(map(self._join, self._wanted, views))

    def close(self) -> None:
        """Stop following the blocks."""
        self._step = None
        for place in self._wanted:
            self._leave(place)
        self._report_taken()

    def give_up(self, _: str) -> None:
        """End the call, because its client is too slow for the steps.

        The call stops following its blocks at once. The stream ends when the client reads again.
        """
        self.late = True
        self.close()
        self._wake.set()

    def wake(self) -> None:
        """Wake the stream, so that it looks for updates, which no longer wait for steps."""
        for place, ring in self._rings.items():
            self._wake_ups.resume(self._blocks[place].view.block, ring)
        self._wake.set()

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch these sources to their new blocks, after a reload."""
        self._moved |= dict.fromkeys(place for place in self._wanted if place.source in sources)
        self._wake.set()

    def mark(self, step: Step) -> bool:
        """Queue the marker of a step. The marker is sent after the changes of the step.

        Returns:
            True if the step has to wait until the client has taken them. False if the call is not open
            yet, because :meth:`open` can take seconds.

        """
        if self.late or not self._opened:
            return False
        self._step = step
        self._wake.set()
        return True

    def _report_taken(self) -> None:
        """Report that the client has taken a step's marker, or that the call has ended."""
        if self.on_taken is not None:
            taken, self.on_taken = self.on_taken, None
            taken(self)

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield serialised SubscribeResponses, without end.

        Raises:
            EndpointError: The client is too slow for the steps or the writes.

        """
        while not self.late:
            for inward in self._inward.values():
                if inward.failure:
                    raise EndpointError(inward.failure)
            self._wake.clear()  # before the checks, so that no wake-up is lost
            batch, whole = self._batch()
            if (step := self._step) and whole and not self._moved:
                self._step = None
                yield batch + field(STEP, wire.Step(number=step.number, time_ns=step.time_ns).SerializeToString())
                self._report_taken()
                await self._wait()  # whatever has come since the batch has woken the stream
            elif batch:
                yield batch
            elif self._moved:
                place = next(iter(self._moved))
                del self._moved[place]
                yield await self._go_over(place)
            else:
                await self._wait()
        raise EndpointError("the client did not read a step in time: it is too slow for the rate of steps")

    def _batch(self) -> tuple[bytes, bool]:
        """Return waiting updates up to a limit, and whether no more updates wait.

        Writes come first. Then the blocks take turns.
        """
        parts: list[bytes] = []
        size, now_s = 0, self._clock()
        for inward in self._inward.values():
            while size < BATCH_BYTES and (written := inward.next()) is not None:
                self.updates += 1
                size += len(written)
                parts.append(field(UPDATES, written))
        waiting = deque(one for one in self._blocks.values() if self._may_send(one))
        waiting.rotate(self._rotation)
        self._rotation += 1  # otherwise a block with long updates would starve the others
        most = len(parts) + BATCH_UPDATES
        while waiting and size < BATCH_BYTES and len(parts) < most:
            block = waiting.popleft()
            update = block.next(now_s)
            if update is None:
                continue
            if block.follower.behind:
                waiting.append(block)
            self.updates += 1
            size += len(update)
            parts.append(field(UPDATES, update))
        return b"".join(parts), not (waiting or any(inward.waits for inward in self._inward.values()))

    def _may_send(self, updates: BlockUpdates) -> bool:
        """Return whether the updates of a block may be sent now.

        In virtual time, updates of a source that steps with the instance wait until the step has
        ended.
        """
        suspended = self._virtual_time.on and updates.view.block.attributes.stepped
        return not suspended or self._step is not None or updates.follower.frame is None

    def _ring(self, place: SourceDirection, updates: BlockUpdates) -> None:
        """Wake the stream, because a block has a new frame or event."""
        if self._may_send(updates):
            self._wake.set()
        else:
            self._wake_ups.join(updates.view.block, self._rings[place], patient=True)

    async def _wait(self) -> None:
        limited = self._blocks.values() if self._request.max_rate_hz else ()
        due_s = min((updates.due_s for updates in limited), default=math.inf)
        if math.isinf(due_s):
            await self._wake.wait()
            return
        handle = asyncio.get_running_loop().call_at(due_s, self._wake.set)
        try:
            await self._wake.wait()
        finally:
            handle.cancel()

    async def _go_over(self, place: SourceDirection) -> bytes:
        """Follow the new block of a source, or report that a reload has removed the source.

        Call this when all updates of the old block have been sent.
        """
        self._leave(place)
        try:
            (view,) = await self._selections.select(
                {place: self._wanted[place]}, frames=self._request.format == wire.FORMAT_FRAMES
            )
            return self._join(place, view)
        except PathError as error:
            direction = wire.DIRECTION_IN if place.inward else wire.DIRECTION_OUT
            ended = wire.Ended(source=place.source, reason=str(error), direction=direction)
            return field(ENDED, ended.SerializeToString())

    def _join(self, place: SourceDirection, view: View) -> bytes:
        request = self._request
        if place.inward and isinstance(view, Selection):
            self._inward[place] = WriteFollower(view.writes, self._selections.commands(place.source), self._wake.set)
            return field(TABLES, view.table)
        if request.mode == wire.MODE_EVERY_FRAME:
            updates: BlockUpdates = EveryFrame(view)
        else:
            updates = LatestFrame(view, 1 / request.max_rate_hz if request.max_rate_hz else 0.0, request.deadband)
        self._blocks[place] = updates
        ring = self._rings[place] = partial(self._ring, place, updates)
        self._wake_ups.join(view.block, ring)
        return field(TABLES, view.table)

    def _leave(self, place: SourceDirection) -> None:
        if inward := self._inward.pop(place, None):
            inward.leave()
        if updates := self._blocks.pop(place, None):
            self._wake_ups.leave(updates.view.block, self._rings.pop(place))


class SubscribeCalls:
    """Serves the call Subscribe, and passes steps and reloads on to all open calls."""

    def __init__(
        self, selections: Selections, wake_ups: WakeUps, timeline: Timeline, open_streams: OpenStreams
    ) -> None:
        """Create the handler of the call.

        Args:
            selections: Makes and caches the views of all clients.
            wake_ups: Wakes the streams.
            timeline: The instance's time.
            open_streams: Counts the open streams of all services together.

        """
        self._selections = selections
        self._wake_ups = wake_ups
        self._virtual_time = timeline.virtual_time
        self._open_streams = open_streams
        self._open: set[SubscribeCall] = set()
        self._ended_updates = 0
        timeline.add_receiver(self)

    @property
    def streams(self) -> int:
        """Number of open Subscribe calls."""
        return len(self._open)

    @property
    def updates(self) -> int:
        """Number of updates that Subscribe calls have sent since the start."""
        return self._ended_updates + sum(subscription.updates for subscription in self._open)

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks that clients read frame by frame, each with the number of the last frame sent."""
        return (reader for subscription in self._open for reader in subscription.readers)

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handler of the call, by name. The handler yields serialised messages."""
        return {"Subscribe": grpc.unary_stream_rpc_method_handler(self.subscribe, wire.SubscribeRequest.FromString)}

    async def subscribe(self, request: wire.SubscribeRequest, context: Context) -> AsyncIterator[bytes]:
        """Stream the present values, then their changes or every frame.

        Statuses:
            NOT_FOUND: There is no such register.
            INVALID_ARGUMENT: There are too many registers, or an option is not valid.
            RESOURCE_EXHAUSTED: There are too many streams, all clients together use too many
                registers, or the client is too slow for the steps or the writes.
        """
        try:
            if len(self._open) >= MAX_STREAMS:
                raise EndpointError(
                    f"{MAX_STREAMS} calls of Subscribe are open, which is the maximum; one call can have many patterns"
                )
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

    def deliver(self, step: Step) -> list[SubscribeCall]:
        """Send the changes and the marker of a step on all streams. Return the streams that have to take them."""
        return [subscription for subscription in self._open if subscription.mark(step)]

    def release(self) -> None:
        """Wake all streams: time is real again, so values no longer wait for steps."""
        for subscription in self._open:
            subscription.wake()

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch the streams of these sources to their new blocks, after a reload."""
        for subscription in self._open:
            subscription.on_sources_replaced(sources)
