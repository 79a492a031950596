"""Delivers a step to all streams: the values that it has changed, then its marker."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import Final, Protocol

from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import Outboxes
from shmio.endpoints.grpc.time.virtual_time import Moment, VirtualTime
from shmio.errors import SegmentError
from shmio.local.time_control import Step
from shmio.model.clock import Clock

PATIENCE_S: Final = 3.0
"""Time that clients have to take a step's values, and again to take its marker.

Clients of shmio.v1 have their turn after the others. The total is less than a step's own
time-out. A stream that is the only one has this time for values and marker together.
"""

log = logging.getLogger("shmio.grpc")


class StepReceiver(Protocol):
    """A service that delivers steps to its own streams."""

    @property
    def streams(self) -> int:
        """Number of the service's open streams."""

    async def deliver(self, step: Step) -> None:
        """Send what a step has changed, then its marker, and wait until all streams have both."""

    def release(self) -> None:
        """Send values as they come, because time is real again."""


class Delivery:
    """Delivers steps in order to all streams, whichever program has made them.

    A step's delivery begins with the writes before it. The changed values follow, of all blocks
    on the instance's clock in the segment's order. When all streams have taken these, they get
    the step's marker, and when they have taken that, the delivery is over. A single stream is
    in order anyway, so nothing is awaited before its marker. For the event loop's thread.
    """

    def __init__(self, virtual_time: VirtualTime, feeds: Mapping[str, Feed], outboxes: Outboxes) -> None:
        self._virtual_time = virtual_time
        self._feeds = feeds
        self._outboxes = outboxes
        self._turn = asyncio.Lock()
        self.receivers: list[StepReceiver] = []

    def begin(self, moment: Moment) -> None:
        """Switch to virtual time; ``moment`` counts as delivered."""
        self._virtual_time.on = True
        self._virtual_time.moment = moment
        for feed in self._feeds.values():
            feed.hold()

    def end(self) -> None:
        """Switch back to real time; only while not :attr:`busy`."""
        self._virtual_time.on = False
        for feed in list(self._feeds.values()):
            try:
                feed.release()
            except SegmentError as error:
                log.warning("time is real again: %s", str(error))
        for receiver in self.receivers:
            receiver.release()

    async def deliver(self, step: Step, mark: Callable[[], None]) -> bool:
        """Deliver a step, with its marker by ``mark``; return False if it was delivered already.

        The stream of a client that does not read fails after ``PATIENCE_S``.
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
        """Whether a step is being delivered now."""
        return self._turn.locked()

    def pass_over(self, step: Step, mark: Callable[[], None]) -> None:
        """Deliver a step without waiting, as no stream is open; only while not :attr:`busy`."""
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


def before(state: Clock) -> Moment:
    """Return the moment that counts as delivered when time is first seen to be virtual.

    On a busy machine the first step may have ended already, and still has to be delivered.
    """
    first = bool(state.dt_ns) and state.step == state.done
    return Moment(state.done - first, state.present_ns - first * state.dt_ns)
