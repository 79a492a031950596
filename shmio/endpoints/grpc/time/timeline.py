"""Follows the instance's time and has each step delivered, whichever program makes it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import OpenStreams, Outboxes
from shmio.endpoints.grpc.streams.wakeups import WakeUp
from shmio.endpoints.grpc.time.delivery import Delivery, StepReceiver, before
from shmio.endpoints.grpc.time.time_topics import TimeTopics
from shmio.endpoints.grpc.time.virtual_time import Moment, TimeStatus, VirtualTime
from shmio.local.time_control import Step
from shmio.model.clock import Clock
from shmio.segment import ProcessSlot, Segment


class Timeline:
    """The instance's time as all services of the endpoint see it; for the event loop's thread."""

    def __init__(
        self,
        segment: Segment,
        slot: ProcessSlot,
        virtual_time: VirtualTime,
        feeds: Mapping[str, Feed],
        outboxes: Outboxes,
        open_streams: OpenStreams,
        play_dt_ns: Callable[[], int | None],
    ) -> None:
        """Read the present time; see :meth:`start`.

        Args:
            segment: The instance's shared memory.
            slot: This process's entry in the process table.
            virtual_time: Updated here and read by the feeds.
            feeds: The feeds of all sources.
            outboxes: The outboxes of all streams.
            open_streams: While there are none, no step waits for this process.
            play_dt_ns: Returns the size of the steps that this process plays, in ns; None: the
                step size.

        """
        self.time_topics = TimeTopics(virtual_time, self._now, lambda: self._clock.read().step_size_ns / 1e9)
        """Sends step numbers and simulation time to subscribers."""
        self.virtual_time = virtual_time
        """Whether time is virtual, and the step delivered last."""
        self.steered = False
        """Whether this process moves time at present and delivers its own steps."""
        self.ended = False
        """Whether a client has said that time goes on no more; reset by the next step."""
        self._clock = segment.clock
        self._slot = slot
        self._open_streams = open_streams
        self._play_dt_ns = play_dt_ns
        self._loop = asyncio.get_running_loop()
        self._delivery = Delivery(virtual_time, feeds, outboxes)
        self._watchers: list[Callable[[TimeStatus], None]] = []
        self._delivering: set[asyncio.Task[Any]] = set()
        self._page: WakeUp | None = None  # when the clock page is written
        state = self._clock.read()
        if state.virtual:
            self._delivery.begin(Moment(state.done, state.present_ns))
        self._told = self._status(state)[1:]
        self._delivered = state.done
        self._awaited = False  # whether steps wait for this process's delivery
        open_streams.changed = self._attend
        virtual_time.look = self.look
        self._attend()

    def start(self) -> None:
        """Start following time."""
        self._page = WakeUp(self._clock.bell, "clock")
        self._page.listeners[self.look] = None

    async def stop(self) -> None:
        """Stop following time, and cancel the deliveries in progress."""
        self.time_topics.stop()
        page, self._page = self._page, None  # own() may still be called
        if page is not None:
            page.stop()
            page.join()
        tasks = list(self._delivering)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    @property
    def alive(self) -> bool:
        """Whether time is being followed."""
        return self._page is not None

    def own(self, owns: bool) -> None:
        """Note whether this process owns time; its own writes to the clock page need no wake-up."""
        if self._page is not None:
            (self._page.mute if owns else self._page.unmute)()

    def add_receiver(self, receiver: StepReceiver) -> None:
        """Deliver each step to ``receiver`` too."""
        self._delivery.receivers.append(receiver)

    def watch(self, watcher: Callable[[TimeStatus], None]) -> None:
        """Call ``watcher`` with each step's status and with each change."""
        self._watchers.append(watcher)

    @property
    def status(self) -> TimeStatus:
        """The present state of time."""
        return self._status(self.look())

    async def deliver(self, step: Step) -> None:
        """Deliver a step's values and marker to all streams, unless they have them already."""
        if await self._delivery.deliver(step, partial(self._mark, step)):
            self._delivered = step.number
            if self._awaited:
                self._clock.deliver(self._slot.index, step.number)

    def look(self) -> Clock:
        """Read the clock page and act on what has changed.

        This is also called periodically, because a player that dies causes no wake-up.
        """
        state = self._clock.read()
        if state.virtual and not self.virtual_time.on:
            self._delivery.begin(before(state))
        elif self.virtual_time.on and not state.virtual and not self._delivery.busy:  # else at the next call
            self._end(state)
        if state.virtual and state.done > self.virtual_time.moment.number and not self.steered:
            step = Step(state.done, state.present_ns, state.dt_ns)
            if self._awaited or self._delivery.busy:
                task = self._loop.create_task(self.deliver(step))
                self._delivering.add(task)
                task.add_done_callback(self._delivering.discard)
            else:
                self._delivered = step.number
                self._delivery.pass_over(step, partial(self._mark, step))
        elif (status := self._status(state))[1:] != self._told:
            self._tell(status, state)
        return state

    def _end(self, state: Clock) -> None:
        """Act on the release of time: it is real again."""
        self._delivery.end()
        self.time_topics.resume()
        self._tell(self._status(state), state)

    def _attend(self) -> None:
        """Make steps wait for this process while it has open streams."""
        if self._open_streams:
            self.look()  # delivers what is over; steps wait from the next one on
            self._awaited = True
            self._clock.deliver(self._slot.index, self._delivered)
        else:
            self._awaited = False
            self._clock.abstain(self._slot.index)

    def _mark(self, step: Step) -> None:
        self.ended = False
        self.time_topics.tell()
        state = self._clock.read()
        self._tell(TimeStatus(step.time_ns, step.dt_ns, True, state.playing), state)

    def _status(self, state: Clock) -> TimeStatus:
        dt_ns = (self._play_dt_ns() if state.playing else None) or state.step_size_ns
        return TimeStatus(self._now().clock_ns, dt_ns, not self.ended, state.playing)

    def _tell(self, status: TimeStatus, state: Clock) -> None:
        self._told = self._status(state)[1:]
        for watcher in self._watchers:
            watcher(status)

    def _now(self) -> Moment:
        return self.virtual_time.moment if self.virtual_time.on else Moment(0, self._clock.read().time_ns)
