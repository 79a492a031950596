"""Follows the instance's time, and delivers each step, whichever program makes the step."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping, Sized
from functools import partial
from typing import NamedTuple, Protocol

from shmio.endpoints.grpc.streams.feed import Feed, Moment, VirtualTime
from shmio.endpoints.grpc.streams.outbox import OpenStreams, Outboxes
from shmio.endpoints.grpc.time.delivery import Delivery, StepReceiver
from shmio.endpoints.grpc.topics import TimeTopic
from shmio.endpoints.grpc.wakeups import WakeUp
from shmio.errors import SegmentError
from shmio.local.time_control import Step
from shmio.model.clock import Clock
from shmio.segment import ProcessSlot, Segment
from shmio.segment.clock import StateAction

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
        """True while this process moves time, until the delivery of its own step has begun."""
        self.ended = False
        """True after a client has called ``stop`` of SimServerAPI, until the next step."""
        self._clock = segment.clock
        self._slot = slot
        self._open_streams = open_streams
        self._play_dt_ns = play_dt_ns
        self._loop = asyncio.get_running_loop()
        self._feeds = feeds
        self._delivery = Delivery(virtual_time, feeds, outboxes, self._end_delivery)
        self._watchers: list[Callable[[TimeStatus], None]] = []
        self._page: WakeUp | None = None  # calls update() when the clock page is written
        self._restored = self._clock.state_request().number  # the last request that has moved time
        state = self._clock.read()
        if state.virtual:
            self._begin(Moment(state.done, state.present_ns))
        self._reported = self._status(state)[1:]
        self._delivered = state.done
        self._awaited = False  # whether steps wait for this process's delivery
        self._followed = False  # whether a client waits for changes of time
        self._postponed = False  # whether update() has to be called when the present delivery ends
        open_streams.changed = self._attend
        virtual_time.update = self.update
        self._attend()

    def start(self) -> None:
        """Start following time."""
        self._page = WakeUp(self._clock.bell, "clock")
        self._page.listeners[self.update] = None
        self._page.patient.add(self.update)

    def stop(self) -> None:
        """Stop following time, and abandon a delivery that has not ended."""
        self.time_topics.stop()
        self._delivery.stop()
        page, self._page = self._page, None  # own() may still be called
        if page is not None:
            page.stop()
            page.join()

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

    def follow(self, *, followed: bool) -> None:
        """Set whether a client waits for changes of time. While one does, no change is noticed late."""
        self._followed = followed
        if followed and self._page is not None:
            self._page.resume()

    @property
    def status(self) -> TimeStatus:
        """The present state of time."""
        return self._status(self.update())

    async def delivered(self) -> None:
        """Wait until no step is being delivered, and all steps noticed meanwhile have been."""
        while self._delivery.busy:
            await self._delivery.over()
            self.update()

    async def deliver(self, step: Step) -> None:
        """Deliver the values and the marker of a step to all streams. Return when all clients have taken them.

        If the task is cancelled, the delivery continues. Call this only while no other step is being
        delivered.
        """
        self._delivery.begin(step, partial(self._mark, step))
        self.steered = False
        await self._delivery.over()

    def end_steering(self) -> None:
        """Let :meth:`update` deliver steps again, and do so unless :meth:`deliver` has delivered the newest."""
        if self.steered:
            self.steered = False
            self.update()

    def update(self) -> Clock:
        """Read the clock page, and react to its changes.

        This is also called periodically: if a program dies while it is playing, no wake-up comes.
        """
        state = self._clock.read()
        if self._delivery.busy:
            self._postponed = True
            return state
        if self.virtual_time.on and (not state.virtual or self._was_real(state)):
            self._end(state)
        if state.virtual and not self.virtual_time.on:
            self._begin(_before(state))
        if state.virtual and not self.steered and self.alive and self._adopt(state):
            return state
        if (status := self._status(state))[1:] != self._reported:
            self._report(status, state)
        return state

    def _was_real(self, state: Clock) -> bool:
        """Return whether time has been real since the last call, so that its cycles were no steps."""
        if state.dt_ns or state.done <= self.virtual_time.moment.number:
            return False
        request = self._clock.state_request()
        before, self._restored = self._restored, request.number  # a snapshot moves time without a step, too
        return request.number == before or request.action is StateAction.SAVE

    def _adopt(self, state: Clock) -> bool:
        """Begin to deliver the last step, if another program has made it. Return whether it has."""
        if state.done < self.virtual_time.moment.number:
            self.virtual_time.moment = Moment(state.done - 1, state.present_ns)  # a snapshot has set time back
            self._restored = self._clock.state_request().number
        if state.done == self.virtual_time.moment.number:
            return False
        step = Step(state.done, state.present_ns, state.dt_ns)
        self._delivery.begin(step, partial(self._mark, step))
        if self._page is not None and not self._awaited and not self._followed:
            self._page.pause()  # nobody waits
        return True

    def _begin(self, moment: Moment) -> None:
        """Switch to virtual time. The step ``moment`` counts as delivered."""
        self.virtual_time.on = True
        self.virtual_time.moment = moment
        for feed in self._feeds.values():
            feed.suspend()

    def _end(self, state: Clock) -> None:
        """Return to real time."""
        self.virtual_time.on = False
        for feed in list(self._feeds.values()):
            try:
                feed.resume()
            except SegmentError as error:
                log.warning("the server did not send some values when the cell returned to real time: %s", str(error))
        for receiver in self._delivery.receivers:
            receiver.release()
        self.time_topics.resume()
        self._report(self._status(state), state)

    def _end_delivery(self) -> None:
        self._delivered = self.virtual_time.moment.number
        if self._awaited:
            self._clock.deliver(self._slot.index, self._delivered)
        if self._postponed:
            self._postponed = False
            self._loop.call_soon(self._catch_up)  # not at once: a fast program would nest the calls without end

    def _catch_up(self) -> None:
        if self.alive:
            self.update()

    def _attend(self) -> None:
        """Make steps wait for this process while it has open streams, and only then."""
        if self._open_streams:
            self.update()  # delivers the steps so far; the next step will wait for this process
            self._awaited = True
            if self._page is not None:
                self._page.resume()
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
