"""The topics of time: the number of each step, and the clock."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sized
from functools import partial
from typing import Protocol

from shmio.endpoints.grpc.commands.topics import TimeTopic
from shmio.endpoints.grpc.time.virtual_time import Moment, VirtualTime


class Listener(Protocol):
    """One stream; called in the event loop's thread."""

    def deliver(self, message: Sized) -> None:
        """Take one message for this stream."""

    def keep(self, message: Sized) -> None:
        """Take one message of a step: it must not be left out."""


Encode = Callable[[TimeTopic, Moment], Sized]
"""How one wire tells a moment."""


class TimeTopics:
    """Tells each step to those who listen, and the clock; that in wall time, too, a step's size apart."""

    def __init__(self, virtual_time: VirtualTime, now: Callable[[], Moment], tick_s: Callable[[], float]) -> None:
        """``now``: simulation time at present. ``tick_s``: the step size."""
        self._virtual_time = virtual_time
        self._now = now
        self._tick_s = tick_s
        self._listeners: dict[tuple[TimeTopic, Encode], dict[Listener, None]] = {}
        self._timer: asyncio.TimerHandle | None = None

    def listen(self, topic: TimeTopic, encode: Encode, listener: Listener) -> Callable[[], None]:
        """Join; the clock is told at once, a step's number only after that step. How to leave again."""
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
        """Tell the step that was delivered."""
        for (topic, encode), listeners in self._listeners.items():
            message = encode(topic, self._virtual_time.moment)
            for listener in listeners:
                listener.keep(message)

    def _set_timer(self) -> None:
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(self._tick_s(), self._tick)

    def _tick(self) -> None:
        """Tell the clock while time goes by itself, as long as anybody listens."""
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
        """Time goes by itself again."""
        if any(topic is TimeTopic.CLOCK for topic, _ in self._listeners):
            self._set_timer()

    def stop(self) -> None:
        """Tell nothing any more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
