"""Follows the instance's time, and delivers each step, whichever program makes the step."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping, Sized
from functools import partial
from typing import Any, Final, NamedTuple, Protocol

from shmio.endpoints.grpc.streams.feed import Feed, Moment, VirtualTime
from shmio.endpoints.grpc.streams.outbox import OpenStreams, Outboxes
from shmio.endpoints.grpc.topics import TimeTopic
from shmio.endpoints.grpc.wakeups import WakeUp
from shmio.errors import SegmentError
from shmio.local.time_control import Step
from shmio.model.clock import Clock
from shmio.segment import ProcessSlot, Segment

PATIENCE_S: Final = 3.0
"""Maximum time in s for clients to take the values of a step, and again to take the step's marker.

Clients of shmio.v1 get a step after the other clients. The total is less than the time-out of a
step. If only one stream is open, it has this time once, for values and marker together.
"""

log = logging.getLogger("shmio.grpc")


class TimeStatus(NamedTuple):
    """The state of the instance's time.

    ``dt_ns`` is the length of the step that the status reports. If the status reports no step, it
    is the length of the steps that are played, or the step size. ``alive`` is False after a client
    has called ``stop`` of SimServerAPI, until the next step.
    """

    clock_ns: int
    dt_ns: int
    alive: bool
    playing: bool


class Listener(Protocol):
    """A stream's subscription to a time topic. The methods are called in the event loop's thread."""

    def deliver(self, message: Sized) -> None:
        """Add one message to the stream."""

    def keep(self, message: Sized) -> None:
        """Add one message of a step to the stream. It must not be dropped."""


Encode = Callable[[TimeTopic, Moment], Sized]
"""Function that encodes a moment as a message of one service."""


class TimeTopics:
    """Sends step numbers and the simulation time to listeners.

    While time is real, the simulation time is sent periodically. The period is the step size.
    """

    def __init__(self, virtual_time: VirtualTime, now: Callable[[], Moment], tick_s: Callable[[], float]) -> None:
        """Start without listeners.

        Args:
            virtual_time: The state of virtual time.
            now: Returns the present simulation time.
            tick_s: Returns the step size, in s.

        """
        self._virtual_time = virtual_time
        self._now = now
        self._tick_s = tick_s
        self._listeners: dict[tuple[TimeTopic, Encode], dict[Listener, None]] = {}
        self._timer: asyncio.TimerHandle | None = None

    def listen(self, topic: TimeTopic, encode: Encode, listener: Listener) -> Callable[[], None]:
        """Add a listener. Return the function that removes it.

        The present simulation time is sent at once. A step's number is sent after the step.

        Args:
            topic: The topic to listen to.
            encode: Encodes a moment as a message.
            listener: Gets the messages.
        """
        listeners = self._listeners.setdefault((topic, encode), {})
        listeners[listener] = None
        if topic is TimeTopic.CLOCK:
            message = encode(topic, self._now())
            if self._virtual_time.on:
                listener.keep(message)
            else:
                listener.deliver(message)
                self._set_timer()
        return partial(self._leave, topic, encode, listener)

    def _leave(self, topic: TimeTopic, encode: Encode, listener: Listener) -> None:
        listeners = self._listeners[topic, encode]
        del listeners[listener]
        if not listeners:
            del self._listeners[topic, encode]

    def publish_step(self) -> None:
        """Send the number and the time of the step that was delivered last."""
        for (topic, encode), listeners in self._listeners.items():
            message = encode(topic, self._virtual_time.moment)
            for listener in listeners:
                listener.keep(message)

    def _set_timer(self) -> None:
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(self._tick_s(), self._tick)

    def _tick(self) -> None:
        """Send the simulation time, while time is real and there is a listener."""
        self._timer = None
        if self._virtual_time.on:
            return
        for (topic, encode), listeners in self._listeners.items():
            if topic is TimeTopic.CLOCK:
                message = encode(topic, self._now())
                for listener in listeners:
                    listener.deliver(message)
                self._set_timer()

    def resume(self) -> None:
        """Start to send the simulation time periodically again, because time is real."""
        if any(topic is TimeTopic.CLOCK for topic, _ in self._listeners):
            self._set_timer()

    def stop(self) -> None:
        """Stop sending the simulation time periodically."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class StepReceiver(Protocol):
    """A service that delivers steps to its own streams."""

    @property
    def streams(self) -> int:
        """Number of the service's open streams."""

    async def deliver(self, step: Step) -> None:
        """Send the changes of a step, and then its marker. Wait until all streams have taken both."""

    def release(self) -> None:
        """Send values without waiting for steps, because time is real again."""


class _Delivery:
    """Delivers steps in order to all streams, whichever program makes the steps.

    First come the writes before the step. Then come the changed values of all blocks on the
    instance's clock, in the segment's order. When all streams have taken these values, they get the
    step's marker. The delivery ends when all streams have taken the marker. If only one stream is
    open, its marker need not wait for the values. Use it only in the event loop's thread.
    """

    def __init__(self, virtual_time: VirtualTime, feeds: Mapping[str, Feed], outboxes: Outboxes) -> None:
        self._virtual_time = virtual_time
        self._feeds = feeds
        self._outboxes = outboxes
        self._lock = asyncio.Lock()
        self.receivers: list[StepReceiver] = []

    def begin(self, moment: Moment) -> None:
        """Switch to virtual time. The step ``moment`` counts as delivered."""
        self._virtual_time.on = True
        self._virtual_time.moment = moment
        for feed in self._feeds.values():
            feed.suspend()

    def end(self) -> None:
        """Switch back to real time. Call this only while not :attr:`busy`."""
        self._virtual_time.on = False
        for feed in list(self._feeds.values()):
            try:
                feed.resume()
            except SegmentError as error:
                log.warning("the server did not send some values when the cell returned to real time: %s", str(error))
        for receiver in self.receivers:
            receiver.release()

    async def deliver(self, step: Step, mark: Callable[[], None]) -> bool:
        """Deliver a step. Return False if it had already been delivered.

        If a client does not read for ``PATIENCE_S``, its stream fails.

        Args:
            step: The step.
            mark: Queues the step's marker.

        """
        async with self._lock:
            if step.number <= self._virtual_time.moment.number:
                return False
            self._show(step)
            if len(self._outboxes) + sum(receiver.streams for receiver in self.receivers) > 1:
                await self._outboxes.delivered(PATIENCE_S)
            for receiver in self.receivers:
                await receiver.deliver(step)
            mark()
            await self._outboxes.delivered(PATIENCE_S)
            return True

    @property
    def busy(self) -> bool:
        """True while a step is being delivered."""
        return self._lock.locked()

    def pass_over(self, step: Step, mark: Callable[[], None]) -> None:
        """Deliver a step without waiting, because no stream is open.

        Call this only while not :attr:`busy`.
        """
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


class Timeline:
    """The instance's time, as all services of the endpoint see it.

    Use it only in the event loop's thread.
    """

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
        """Read the present time; :meth:`start` starts following it.

        Args:
            segment: The instance's shared memory.
            slot: This process's entry in the process table.
            virtual_time: The state of virtual time. This object updates it, and the feeds read it.
            feeds: The feeds of all sources, by name.
            outboxes: The outboxes of all streams.
            open_streams: Counts the open streams. While no stream is open, no step waits for this
                process.
            play_dt_ns: Returns the length of the steps that this process plays, in ns; None for the
                step size.

        """
        self.time_topics = TimeTopics(virtual_time, self._now, lambda: self._clock.read().step_size_ns / 1e9)
        """Sends step numbers and simulation time to subscribers."""
        self.virtual_time = virtual_time
        """The state of virtual time, with the last delivered step."""
        self.steered = False
        """True while this process moves time, and delivers its own steps."""
        self.ended = False
        """True after a client has called ``stop`` of SimServerAPI, until the next step."""
        self._clock = segment.clock
        self._slot = slot
        self._open_streams = open_streams
        self._play_dt_ns = play_dt_ns
        self._loop = asyncio.get_running_loop()
        self._delivery = _Delivery(virtual_time, feeds, outboxes)
        self._watchers: list[Callable[[TimeStatus], None]] = []
        self._delivering: set[asyncio.Task[Any]] = set()
        self._page: WakeUp | None = None  # calls update() when the clock page is written
        state = self._clock.read()
        if state.virtual:
            self._delivery.begin(Moment(state.done, state.present_ns))
        self._reported = self._status(state)[1:]
        self._delivered = state.done
        self._awaited = False  # whether steps wait for this process's delivery
        open_streams.changed = self._attend
        virtual_time.update = self.update
        self._attend()

    def start(self) -> None:
        """Start following time."""
        self._page = WakeUp(self._clock.bell, "clock")
        self._page.listeners[self.update] = None

    async def stop(self) -> None:
        """Stop following time, and cancel the deliveries that have not ended."""
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
        """True while this object follows time."""
        return self._page is not None

    def own(self, owns: bool) -> None:
        """Set whether this process controls time.

        If it does, its own changes of the clock page need no wake-up.
        """
        if self._page is not None:
            (self._page.mute if owns else self._page.unmute)()

    def add_receiver(self, receiver: StepReceiver) -> None:
        """Add a service that also receives each step."""
        self._delivery.receivers.append(receiver)

    def watch(self, watcher: Callable[[TimeStatus], None]) -> None:
        """Call ``watcher`` with the status of time, after each step and each other change."""
        self._watchers.append(watcher)

    @property
    def status(self) -> TimeStatus:
        """The present state of time."""
        return self._status(self.update())

    async def deliver(self, step: Step) -> None:
        """Deliver the values and the marker of a step to all streams, unless that has been done already."""
        if await self._delivery.deliver(step, partial(self._mark, step)):
            self._delivered = step.number
            if self._awaited:
                self._clock.deliver(self._slot.index, step.number)

    def update(self) -> Clock:
        """Read the clock page, and react to its changes.

        This is also called periodically: if a program dies while it is playing, no wake-up comes.
        """
        state = self._clock.read()
        if state.virtual and not self.virtual_time.on:
            self._delivery.begin(_before(state))
        elif self.virtual_time.on and not state.virtual and not self._delivery.busy:  # if busy, at the next call
            self._end(state)
        if state.virtual and state.done < self.virtual_time.moment.number and not self.steered:
            self.virtual_time.moment = Moment(state.done - 1, state.present_ns)  # a snapshot has set time back
        if state.virtual and state.done > self.virtual_time.moment.number and not self.steered:
            step = Step(state.done, state.present_ns, state.dt_ns)
            if self._awaited or self._delivery.busy:
                task = self._loop.create_task(self.deliver(step))
                self._delivering.add(task)
                task.add_done_callback(self._delivering.discard)
            else:
                self._delivered = step.number
                self._delivery.pass_over(step, partial(self._mark, step))
        elif (status := self._status(state))[1:] != self._reported:
            self._report(status, state)
        return state

    def _end(self, state: Clock) -> None:
        """Handle the return to real time."""
        self._delivery.end()
        self.time_topics.resume()
        self._report(self._status(state), state)

    def _attend(self) -> None:
        """Make steps wait for this process while it has open streams, and only then."""
        if self._open_streams:
            self.update()  # delivers the steps so far; the next step will wait for this process
            self._awaited = True
            self._clock.deliver(self._slot.index, self._delivered)
        else:
            self._awaited = False
            self._clock.abstain(self._slot.index)

    def _mark(self, step: Step) -> None:
        self.ended = False
        self.time_topics.publish_step()
        state = self._clock.read()
        self._report(TimeStatus(step.time_ns, step.dt_ns, True, state.playing), state)

    def _status(self, state: Clock) -> TimeStatus:
        dt_ns = (self._play_dt_ns() if state.playing else None) or state.step_size_ns
        return TimeStatus(self._now().clock_ns, dt_ns, not self.ended, state.playing)

    def _report(self, status: TimeStatus, state: Clock) -> None:
        self._reported = self._status(state)[1:]
        for watcher in self._watchers:
            watcher(status)

    def _now(self) -> Moment:
        return self.virtual_time.moment if self.virtual_time.on else Moment(0, self._clock.read().time_ns)


def _before(state: Clock) -> Moment:
    """Return the moment that counts as delivered when this process first sees that time is virtual.

    On a busy machine, the first step may have ended by then, and still has to be delivered.
    """
    first = bool(state.dt_ns) and state.step == state.done
    return Moment(state.done - first, state.present_ns - first * state.dt_ns)
