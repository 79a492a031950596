"""How the instance's time stands for all services: follows it, has each step delivered and told, whoever makes it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outboxes import Outboxes
from shmio.endpoints.grpc.streams.wakeups import WakeUp
from shmio.endpoints.grpc.time.delivery import Delivery, StepReceiver, before
from shmio.endpoints.grpc.time.open_streams import OpenStreams
from shmio.endpoints.grpc.time.time_topics import TimeTopics
from shmio.endpoints.grpc.time.virtual_time import Moment, TimeStatus, VirtualTime
from shmio.local.time_control import Step
from shmio.segment import ProcessSlot, Segment
from shmio.segment.clock import ClockState


class Timeline:
    """For the event loop's thread."""

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
        """``slot``: this process's in the table. ``audience``: while there is none, no step waits for it.

        ``play_dt_ns``: of each step that this process plays; None: the step size.
        """
        self.time_topics = TimeTopics(virtual_time, self._now, lambda: self._clock.read().step_size_ns / 1e9)
        """Tells steps and time."""
        self.virtual_time = virtual_time
        """Whether time is virtual, and what was delivered."""
        self.steered = False
        """Whether this process moves time at present, and has its steps delivered by itself."""
        self.ended = False
        """Whether somebody has said that time goes on no more; until it does."""
        self._clock = segment.clock
        self._slot = slot
        self._open_streams = open_streams
        self._play_dt_ns = play_dt_ns
        self._loop = asyncio.get_running_loop()
        self._delivery = Delivery(virtual_time, feeds, outboxes)
        self._watchers: list[Callable[[TimeStatus], None]] = []
        self._delivering: set[asyncio.Task[Any]] = set()
        self._page: WakeUp | None = None  # rings when it is written
        state = self._clock.read()
        if state.virtual:
            self._delivery.begin(Moment(state.done, state.present_ns))
        self._told = self._status(state)[1:]
        self._delivered = state.done
        self._awaited = False  # whether steps wait for this process
        open_streams.changed = self._attend
        virtual_time.look = self.look
        self._attend()

    def start(self) -> None:
        """Begin to follow time."""
        self._page = WakeUp(self._clock.bell, "clock")
        self._page.listeners[self.look] = None

    async def stop(self) -> None:
        """Deliver and tell nothing more."""
        self.time_topics.stop()
        page, self._page = self._page, None  # who moves time may still give it up, and have it ring again
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
        """Whether this process owns time: nobody but the owner writes the page."""
        if self._page is not None:
            (self._page.mute if owns else self._page.unmute)()

    def add_receiver(self, receiver: StepReceiver) -> None:
        """Have each step delivered to others, too, before it is over."""
        self._delivery.receivers.append(receiver)

    def watch(self, watcher: Callable[[TimeStatus], None]) -> None:
        """Have it told of each step and of each change."""
        self._watchers.append(watcher)

    @property
    def status(self) -> TimeStatus:
        """How time stands."""
        return self._status(self.look())

    async def deliver(self, step: Step) -> None:
        """Have all streams take what a step has changed, and its marker, unless they have already."""
        if await self._delivery.deliver(step, partial(self._mark, step)):
            self._delivered = step.number
            if self._awaited:
                self._clock.deliver(self._slot.index, step.number)

    def look(self) -> ClockState:
        """Heed what the page says by now; also called now and then, for the death of who plays rings no bell."""
        state = self._clock.read()
        if state.virtual and not self.virtual_time.on:
            self._delivery.begin(before(state))
        elif self.virtual_time.on and not state.virtual and not self._delivery.busy:  # else with the next look
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

    def _end(self, state: ClockState) -> None:
        """Time was released: it goes by itself again."""
        self._delivery.end()
        self.time_topics.resume()
        self._tell(self._status(state), state)

    def _attend(self) -> None:
        """Have steps wait for this process from now on, or no longer."""
        if self._open_streams:
            self.look()  # it is shown what is over by now, and waited for from the next step on
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

    def _status(self, state: ClockState) -> TimeStatus:
        dt_ns = (self._play_dt_ns() if state.playing else None) or state.step_size_ns
        return TimeStatus(self._now().clock_ns, dt_ns, not self.ended, state.playing)

    def _tell(self, status: TimeStatus, state: ClockState) -> None:
        self._told = self._status(state)[1:]
        for watcher in self._watchers:
            watcher(status)

    def _now(self) -> Moment:
        return self.virtual_time.moment if self.virtual_time.on else Moment(0, self._clock.read().time_ns)
