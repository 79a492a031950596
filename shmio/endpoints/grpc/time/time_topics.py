"""The topics of time: the number of each step, and the simulation time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sized
from functools import partial
from typing import Protocol

from shmio.endpoints.grpc.commands.topics import TimeTopic
from shmio.endpoints.grpc.time.virtual_time import Moment, VirtualTime


class Listener(Protocol):
    """A stream's subscription to a topic of time; called in the event loop's thread."""

    def deliver(self, message: Sized) -> None:
        """Take one message."""

    def keep(self, message: Sized) -> None:
        """Take one message of a step, which must not be dropped."""


Encode = Callable[[TimeTopic, Moment], Sized]
"""Encodes a moment as a message of one service."""


class TimeTopics:
    """Sends step numbers and simulation time to listeners.

    While time is real, the simulation time is sent once per step size.
    """

    def __init__(self, virtual_time: VirtualTime, now: Callable[[], Moment], tick_s: Callable[[], float]) -> None:
        """``now`` returns the present simulation time, ``tick_s`` the step size."""
        self._virtual_time = virtual_time
        self._now = now
        self._tick_s = tick_s
        self._listeners: dict[tuple[TimeTopic, Encode], dict[Listener, None]] = {}
        self._timer: asyncio.TimerHandle | None = None

    def listen(self, topic: TimeTopic, encode: Encode, listener: Listener) -> Callable[[], None]:
        """Add a listener and return the function that removes it.

        The simulation time is sent at once, a step's number only after that step.
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

    def tell(self) -> None:
        """Send number and time of the step that was delivered."""
        for (topic, encode), listeners in self._listeners.items():
            message = encode(topic, self._virtual_time.moment)
            for listener in listeners:
                listener.keep(message)

    def _set_timer(self) -> None:
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(self._tick_s(), self._tick)

    def _tick(self) -> None:
        """Send the simulation time while time is real, as long as there is a listener."""
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
        """Send the simulation time periodically again, because time is real."""
        if any(topic is TimeTopic.CLOCK for topic, _ in self._listeners):
            self._set_timer()

    def stop(self) -> None:
        """Stop sending the simulation time periodically."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
