"""Subscribe: one stream over any number of blocks."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator, Collection, Iterator
from typing import Final

from shmio.endpoints.grpc.encoding import field
from shmio.endpoints.grpc.native.bells import Bells
from shmio.endpoints.grpc.native.follow import EveryFrame, Follower, Latest
from shmio.endpoints.grpc.native.selection import Selections
from shmio.endpoints.grpc.native.views import View
from shmio.errors import PathError, ValueRangeError
from shmio.wire import shmio_v1_pb2 as wire

BATCH_BYTES: Final = 1 << 18
"""What has come of all blocks goes out in one message up to this size."""
MAX_RATE_HZ: Final = 1e6

TABLES, UPDATES, ENDED = (
    wire.SubscribeResponse.DESCRIPTOR.fields_by_name[name].number for name in ("tables", "updates", "ended")
)


def check(request: wire.SubscribeRequest) -> None:
    """ValueRangeError: options that are none, or do not go together."""
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


class Subscription:
    """One call of Subscribe."""

    def __init__(self, selections: Selections, bells: Bells, request: wire.SubscribeRequest) -> None:
        """PathError, ValueRangeError: as of the request."""
        check(request)
        self.updates = 0
        self._selections = selections
        self._bells = bells
        self._request = request
        self._wanted = selections.resolve(request.patterns)
        self._followers: dict[str, Follower] = {}
        self._moved: dict[str, None] = {}
        self._turn = 0
        self._news = asyncio.Event()
        self._clock = asyncio.get_running_loop().time

    async def open(self) -> bytes:
        """Join all blocks; the tables. PathError, ValueRangeError, EndpointError."""
        views = await self._selections.select(self._wanted, frames=self._request.format == wire.FORMAT_FRAMES)
        return b"".join(map(self._join, views))

    def close(self) -> None:
        """Leave them."""
        for source in list(self._followers):
            self._leave(source)

    def move(self, sources: Collection[str]) -> None:
        """A reload has changed these sources."""
        self._moved |= dict.fromkeys(source for source in self._wanted if source in sources)
        self._news.set()

    async def messages(self) -> AsyncIterator[bytes]:
        """Serialised SubscribeResponses, without end."""
        while True:
            self._news.clear()  # before looking
            if batch := b"".join(self._batch()):
                yield batch
            elif self._moved:
                source = next(iter(self._moved))
                del self._moved[source]
                yield await self._go_over(source)
            else:
                await self._wait()

    def _batch(self) -> Iterator[bytes]:
        """What there is at present, up to a bound; of each block in turn."""
        size, now_s = 0, self._clock()
        waiting = deque(self._followers.values())
        waiting.rotate(self._turn)
        self._turn += 1  # else one with long updates would hide the others
        while waiting and size < BATCH_BYTES:
            update = waiting[0].next(now_s)
            if update is None:
                waiting.popleft()
                continue
            waiting.rotate(-1)
            self.updates += 1
            size += len(update)
            yield field(UPDATES, update)

    async def _wait(self) -> None:
        due_s = min((follower.due_s for follower in self._followers.values()), default=math.inf)
        if math.isinf(due_s):
            await self._news.wait()
            return
        handle = asyncio.get_running_loop().call_at(due_s, self._news.set)
        try:
            await self._news.wait()
        finally:
            handle.cancel()

    async def _go_over(self, source: str) -> bytes:
        """Follow the block that a source has by now, or say that it has none; all of the old one was sent."""
        if source in self._followers:
            self._leave(source)
        try:
            views = await self._selections.select(
                {source: self._wanted[source]}, frames=self._request.format == wire.FORMAT_FRAMES
            )
        except PathError as error:
            return field(ENDED, wire.Ended(source=source, reason=str(error)).SerializeToString())
        return b"".join(map(self._join, views))

    def _join(self, view: View) -> bytes:
        request = self._request
        if request.mode == wire.MODE_EVERY_FRAME:
            follower: Follower = EveryFrame(view)
        else:
            follower = Latest(view, 1 / request.max_rate_hz if request.max_rate_hz else 0.0, request.deadband)
        self._followers[view.block.source] = follower
        self._bells.join(view.block, self._news.set)
        return field(TABLES, view.table)

    def _leave(self, source: str) -> None:
        follower = self._followers.pop(source)
        self._bells.leave(follower.view.block, self._news.set)
