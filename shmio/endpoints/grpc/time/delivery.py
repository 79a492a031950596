"""The delivery of a step: everything that it has changed, then its marker, each taken by every stream."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import Final, Protocol

from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outboxes import Outboxes
from shmio.endpoints.grpc.time.virtual_time import Moment, VirtualTime
from shmio.errors import SegmentError
from shmio.local.time_control import Step
from shmio.segment.clock import ClockState

PATIENCE_S: Final = 3.0
"""So long clients have for the values of a step, those of shmio.v1 after the others, and again for its marker; all
together less than a step's own time-out. A stream that is the only one has so long for both."""

log = logging.getLogger("shmio.grpc")


class StepReceiver(Protocol):
    """Who has streams of his own."""

    @property
    def streams(self) -> int:
        """How many there are."""

    async def deliver(self, step: Step) -> None:
        """Send what has changed in a step, then that it is over, and wait until they have it."""

    def release(self) -> None:
        """Time is real again: send whatever there is."""


class Delivery:
    """Delivers steps in one order to all streams, whoever has made them; for the event loop's thread.

    First what was written before, then what has changed in all blocks on the instance's clock, in the segment's order;
    when all streams have taken that, the marks; when they have taken those, it is over. Within a stream all comes in
    order anyhow: nothing is waited for before the marks if there is only one.
    """

    def __init__(self, virtual_time: VirtualTime, feeds: Mapping[str, Feed], outboxes: Outboxes) -> None:
        self._virtual_time = virtual_time
        self._feeds = feeds
        self._outboxes = outboxes
        self._turn = asyncio.Lock()
        self.receivers: list[StepReceiver] = []

    def begin(self, moment: Moment) -> None:
        """Time has become virtual, and this is what was delivered of it."""
        self._virtual_time.on = True
        self._virtual_time.moment = moment
        for feed in self._feeds.values():
            feed.hold()

    def end(self) -> None:
        """Time is real again; while no step is :attr:`busy`."""
        self._virtual_time.on = False
        for feed in list(self._feeds.values()):
            try:
                feed.release()
            except SegmentError as error:
                log.warning("time is real again: %s", str(error))
        for receiver in self.receivers:
            receiver.release()

    async def deliver(self, step: Step, mark: Callable[[], None]) -> bool:
        """Deliver a step, and ``mark`` it; False if it has been already.

        The stream of a client that does not read ends ``PATIENCE_S`` later.
        """
        async with self._turn:
            if step.number <= self._virtual_time.moment.number:
                return False
            self._show(step)
            if len(self._outboxes) + sum(receiver.streams for receiver in self.receivers) > 1:
                await self._outboxes.taken(PATIENCE_S)
            for receiver in self.receivers:
                await receiver.deliver(step)
            mark()
            await self._outboxes.taken(PATIENCE_S)
            return True

    @property
    def busy(self) -> bool:
        """Whether a step is being delivered."""
        return self._turn.locked()

    def pass_over(self, step: Step, mark: Callable[[], None]) -> None:
        """Deliver a step for which there is no stream, unless it has been already; while none is :attr:`busy`."""
        if step.number > self._virtual_time.moment.number:
            self._show(step)
            mark()

    def _show(self, step: Step) -> None:
        for feed in list(self._feeds.values()):
            if feed.block.attributes.stepped:
                feed.commands.catch_up()
        self._virtual_time.moment = Moment(step.number, step.time_ns)
        for feed in list(self._feeds.values()):
            try:
                feed.step()
            except SegmentError as error:
                log.warning("step %d: %s", step.number, str(error))


def before(state: ClockState) -> Moment:
    """What is delivered when time is found virtual: on a busy machine its first step may be over, and waits for us."""
    first = bool(state.dt_ns) and state.step == state.done
    return Moment(state.done - first, state.present_ns - first * state.dt_ns)
