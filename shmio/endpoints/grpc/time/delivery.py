"""Delivers steps to all streams, in order."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, Protocol

from shmio.endpoints.grpc.streams.feed import Feed, Moment, VirtualTime
from shmio.endpoints.grpc.streams.outbox import Outboxes, StepStream
from shmio.errors import SegmentError
from shmio.local.time_control import Step

PATIENCE_S: Final = 3.0
"""Maximum time in s for clients to take the values of a step, and again to take the step's marker.

Clients of shmio.v1 get a step after the other clients. The total is less than the time-out of a
step. If only one stream is open, it has this time once, for values and marker together.
"""

log = logging.getLogger("shmio.grpc")


class StepReceiver(Protocol):
    """A service that delivers steps to its own streams."""

    @property
    def streams(self) -> int:
        """Number of the service's open streams."""

    def deliver(self, step: Step) -> Iterable[StepStream]:
        """Send the changes of a step, and then its marker. Return the streams that have to take them."""

    def release(self) -> None:
        """Send values without waiting for steps, because time is real again."""


class Delivery:
    """Delivers one step at a time to all streams, whichever program makes the steps.

    First come the writes before the step. Then come the changed values of all blocks on the
    instance's clock, in the segment's order. When all streams have taken these values, they get the
    step's marker. The delivery ends when all streams have taken the marker. If only one stream is
    open, its marker need not wait for the values.

    The streams themselves continue the delivery, by reporting what their clients have taken. So it
    needs no task, and ends even if the client that has asked for the step is gone. Use it only in
    the event loop's thread.
    """

    def __init__(
        self, virtual_time: VirtualTime, feeds: Mapping[str, Feed], outboxes: Outboxes, ended: Callable[[], object]
    ) -> None:
        """Create the delivery.

        Args:
            virtual_time: The state of virtual time. The delivery of a step updates it.
            feeds: The feeds of all sources, by name.
            outboxes: The outboxes of all streams.
            ended: Called when the delivery of a step has ended.

        """
        self.receivers: list[StepReceiver] = []
        self._virtual_time = virtual_time
        self._feeds = feeds
        self._outboxes = outboxes
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self._stages: Iterator[Iterable[StepStream]] | None = None  # of the present delivery
        self._late: set[StepStream] = set()  # streams whose clients have not taken their part of the present stage
        self._due_s = 0.0  # when the late streams fail
        self._timer: asyncio.TimerHandle | None = None
        self._waiters: list[asyncio.Future[None]] = []

    @property
    def busy(self) -> bool:
        """True while a step is being delivered."""
        return self._stages is not None

    def begin(self, step: Step, mark: Callable[[], None]) -> None:
        """Begin to deliver a step. Call this only while not :attr:`busy`.

        If a client does not read for ``PATIENCE_S``, its stream fails.

        Args:
            step: The step.
            mark: Queues the step's marker.

        """
        self._stages = self._deliver(step, mark)
        self._advance()

    async def over(self) -> None:
        """Wait until no step is being delivered."""
        while self.busy:
            waiter = self._loop.create_future()
            self._waiters.append(waiter)
            await waiter

    def stop(self) -> None:
        """Abandon the present delivery."""
        self._stages = None
        self._late.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._wake()

    def _deliver(self, step: Step, mark: Callable[[], None]) -> Iterator[Iterable[StepStream]]:
        """Deliver a step; after each stage, yield the streams that have to take their part before the next stage."""
        self._show(step)
        if len(self._outboxes) + sum(receiver.streams for receiver in self.receivers) > 1:
            yield self._outboxes.undelivered()
        for receiver in self.receivers:
            yield receiver.deliver(step)
        mark()
        yield self._outboxes.undelivered()

    def _advance(self) -> None:
        """Continue the present delivery until it has to wait for streams."""
        try:
            for streams in self._stages or ():
                self._late.update(streams)
                if self._late:
                    self._wait()
                    return
        except Exception:
            log.exception("the server did not deliver all of a step")
        self._stages = None
        self._wake()
        self._ended()

    def _wait(self) -> None:
        for stream in self._late:
            stream.on_taken = self._taken
        self._due_s = self._loop.time() + PATIENCE_S
        if self._timer is None:  # one timer for all steps, because nearly every client takes its part at once
            self._timer = self._loop.call_at(self._due_s, self._check)

    def _taken(self, stream: StepStream) -> None:
        if stream in self._late:  # it is not after stop()
            self._late.discard(stream)
            if not self._late:
                self._advance()

    def _check(self) -> None:
        self._timer = None
        if not self._late:
            return
        if self._loop.time() < self._due_s:
            self._timer = self._loop.call_at(self._due_s, self._check)
            return
        for stream in list(self._late):
            stream.give_up(f"the client has not taken the values of a step within {PATIENCE_S:g} s")

    def _wake(self) -> None:
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)

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
