"""The call Subscribe: one stream over any number of blocks."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator, Collection
from functools import partial
from typing import Final

from shmio.endpoints.grpc.shmio_v1.follow import BlockFollower, EveryFrame, LatestFrame
from shmio.endpoints.grpc.shmio_v1.selection import Selections, SourceDirection
from shmio.endpoints.grpc.shmio_v1.views import Selection, View
from shmio.endpoints.grpc.shmio_v1.write_updates import WriteFollower
from shmio.endpoints.grpc.streams.encoding import field
from shmio.endpoints.grpc.streams.wakeups import Callback, WakeUps
from shmio.endpoints.grpc.time.virtual_time import VirtualTime
from shmio.errors import EndpointError, PathError, ValueRangeError
from shmio.local.time_control import Step
from shmio.wire import shmio_v1_pb2 as wire

BATCH_BYTES: Final = 1 << 18
"""Size up to which the updates of all blocks are sent in one message."""
BATCH_UPDATES: Final = 256
"""Bound of one message's frame updates, which take milliseconds: then other tasks run."""
MAX_RATE_HZ: Final = 1e6

TABLES, UPDATES, ENDED, STEP = (
    wire.SubscribeResponse.DESCRIPTOR.fields_by_name[name].number for name in ("tables", "updates", "ended", "step")
)


def check(request: wire.SubscribeRequest) -> None:
    """Raise ValueRangeError if options are not valid or do not go together."""
    if request.mode not in wire.Mode.values() or request.format not in wire.Format.values():
        raise ValueRangeError(f"mode {request.mode}, format {request.format}: this version has 0 and 1 of each")
    for name, value, most in (
        ("max_rate_hz", request.max_rate_hz, MAX_RATE_HZ),
        ("deadband", request.deadband, math.inf),
    ):
        if not 0 <= value <= most or math.isinf(value):
            raise ValueRangeError(
                f"{name}: {value} is not a number from 0 on{'' if math.isinf(most) else f', at most {most:g}'}"
            )
    if request.mode == wire.MODE_EVERY_FRAME and (request.max_rate_hz or request.deadband):
        raise ValueRangeError("max_rate_hz and deadband are for the mode LATEST: every frame is every frame")
    if request.format == wire.FORMAT_FRAMES and request.deadband:
        raise ValueRangeError("deadband is for the format VALUES")


class SubscribeCall:
    """A Subscribe call: follows its blocks and collects their updates."""

    def __init__(
        self, selections: Selections, wake_ups: WakeUps, virtual_time: VirtualTime, request: wire.SubscribeRequest
    ) -> None:
        """Check the request. Raises PathError or ValueRangeError."""
        check(request)
        self.updates = 0
        self.late = False
        """Whether a step has waited too long for the client; see :meth:`give_up`."""
        self._virtual_time = virtual_time
        self._opened = False
        self._step_marks: deque[tuple[Step, asyncio.Future[None]]] = deque()
        self._selections = selections
        self._wake_ups = wake_ups
        self._request = request
        self._wanted = selections.resolve(request.patterns, inward=True)
        if request.format == wire.FORMAT_FRAMES and any(place.inward for place in self._wanted):
            raise ValueRangeError("what is written has no raw frames: leave out /in, or ask for the format VALUES")
        self._followers: dict[SourceDirection, BlockFollower] = {}
        self._inward: dict[SourceDirection, WriteFollower] = {}
        self._rings: dict[SourceDirection, Callback] = {}  # the callbacks of their wake-ups
        self._moved: dict[SourceDirection, None] = {}
        self._turn = 0
        self._wake = asyncio.Event()
        self._clock = asyncio.get_running_loop().time

    async def open(self) -> bytes:
        """Start following all blocks; return the tables.

        Raises PathError, ValueRangeError and EndpointError as :meth:`Selections.select`.
        """
        views = await self._selections.select(self._wanted, frames=self._request.format == wire.FORMAT_FRAMES)
        self._opened = True
        return b"".join(map(self._join, self._wanted, views))

    def close(self) -> None:
        """Stop following the blocks."""
        while self._step_marks:
            _set(self._step_marks.popleft()[1])
        for place in self._wanted:
            self._leave(place)

    def give_up(self) -> None:
        """End a call that is too slow for steps: release all now, end when the client reads."""
        self.late = True
        self.close()
        self._wake.set()

    def wake(self) -> None:
        """Wake the stream to look for updates."""
        self._wake.set()

    def move(self, sources: Collection[str]) -> None:
        """Switch these sources to their present blocks, after a reload."""
        self._moved |= dict.fromkeys(place for place in self._wanted if place.source in sources)
        self._wake.set()

    def mark(self, step: Step) -> asyncio.Future[None]:
        """Queue a step's marker, to be sent after the step's changes.

        Returns:
            A future that is done when the marker was sent or the call has ended. Before
            :meth:`open` has returned, which takes seconds for a large layout, it is done at once.

        """
        sent = asyncio.get_running_loop().create_future()
        if self.late or not self._opened:
            sent.set_result(None)
        else:
            self._step_marks.append((step, sent))
            self._wake.set()
        return sent

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield serialised SubscribeResponses without end.

        EndpointError: the client is too slow for steps or writes.
        """
        while not self.late:
            for inward in self._inward.values():
                if inward.failure:
                    raise EndpointError(inward.failure)
            self._wake.clear()  # before looking
            batch, whole = self._batch()
            if self._step_marks and whole and not self._moved:
                step, sent = self._step_marks.popleft()
                try:
                    yield batch + field(STEP, wire.Step(number=step.number, time_ns=step.time_ns).SerializeToString())
                finally:
                    _set(sent)
            elif batch:
                yield batch
            elif self._moved:
                place = next(iter(self._moved))
                del self._moved[place]
                yield await self._go_over(place)
            else:
                await self._wait()
        raise EndpointError("a step has waited too long to be read: this client is too slow for how time is stepped")

    def _batch(self) -> tuple[bytes, bool]:
        """Return the present updates up to a bound, and whether these are all.

        Writes come first, then the updates of the blocks in turn.
        """
        parts: list[bytes] = []
        size, now_s = 0, self._clock()
        for inward in self._inward.values():
            while size < BATCH_BYTES and (written := inward.next()) is not None:
                self.updates += 1
                size += len(written)
                parts.append(field(UPDATES, written))
        waiting = deque(follower for follower in self._followers.values() if self._open(follower))
        waiting.rotate(self._turn)
        self._turn += 1  # else a block with long updates would starve the others
        most = len(parts) + BATCH_UPDATES
        while waiting and size < BATCH_BYTES and len(parts) < most:
            update = waiting[0].next(now_s)
            if update is None:
                waiting.popleft()
                continue
            waiting.rotate(-1)
            self.updates += 1
            size += len(update)
            parts.append(field(UPDATES, update))
        return b"".join(parts), not (waiting or any(inward.waits for inward in self._inward.values()))

    def _open(self, follower: BlockFollower) -> bool:
        """Return whether a block's updates may be sent now.

        In virtual time those of a block on the instance's clock wait for the end of a step.
        """
        held = self._virtual_time.on and follower.view.block.attributes.stepped
        return not held or bool(self._step_marks) or not follower.begun

    def _ring(self, follower: BlockFollower) -> None:
        """Wake the stream, because the follower's block has something new."""
        if self._open(follower):
            self._wake.set()

    async def _wait(self) -> None:
        due_s = min((follower.due_s for follower in self._followers.values()), default=math.inf)
        if math.isinf(due_s):
            await self._wake.wait()
            return
        handle = asyncio.get_running_loop().call_at(due_s, self._wake.set)
        try:
            await self._wake.wait()
        finally:
            handle.cancel()

    async def _go_over(self, place: SourceDirection) -> bytes:
        """Follow a source's present block, or report that it has none, after all of the old one."""
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
            follower: BlockFollower = EveryFrame(view)
        else:
            follower = LatestFrame(view, 1 / request.max_rate_hz if request.max_rate_hz else 0.0, request.deadband)
        self._followers[place] = follower
        ring = self._rings[place] = partial(self._ring, follower)
        self._wake_ups.join(view.block, ring)
        return field(TABLES, view.table)

    def _leave(self, place: SourceDirection) -> None:
        if inward := self._inward.pop(place, None):
            inward.leave()
        if follower := self._followers.pop(place, None):
            self._wake_ups.leave(follower.view.block, self._rings.pop(place))


def _set(sent: asyncio.Future[None]) -> None:
    if not sent.done():
        sent.set_result(None)
