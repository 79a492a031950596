"""The topics of time: the number of each step, and the clock."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sized
from functools import partial
from typing import Protocol

from shmio.endpoints.grpc.commands.topics import Mark
from shmio.endpoints.grpc.time.virtual_time import Hold, Moment


class Listener(Protocol):
    """One stream; called in the event loop's thread."""

    def deliver(self, message: Sized) -> None:
        """Take one message for this stream."""

    def keep(self, message: Sized) -> None:
        """Take one message of a step: it must not be left out."""


Encode = Callable[[Mark, Moment], Sized]
"""How one wire tells a moment."""


class Marks:
    """Tells each step to those who listen, and the clock; that in wall time, too, a step's size apart."""

    def __init__(self, hold: Hold, now: Callable[[], Moment], tick_s: Callable[[], float]) -> None:
        """``now``: simulation time at present. ``tick_s``: the step size."""
        self._hold = hold
        self._now = now
        self._tick_s = tick_s
        self._listeners: dict[tuple[Mark, Encode], dict[Listener, None]] = {}
        self._timer: asyncio.TimerHandle | None = None

    def listen(self, mark: Mark, encode: Encode, listener: Listener) -> Callable[[], None]:
        """Join; the clock is told at once, a step's number only after that step. How to leave again."""
        listeners = self._listeners.setdefault((mark, encode), {})
        listeners[listener] = None
        if mark is Mark.CLOCK:
            message = encode(mark, self._now())
            if self._hold.on:
                listener.keep(message)
            else:
                listener.deliver(message)
                self._set_timer()
        return partial(self._leave, mark, encode, listener)

    def _leave(self, mark: Mark, encode: Encode, listener: Listener) -> None:
        listeners = self._listeners[mark, encode]
        del listeners[listener]
        if not listeners:
            del self._listeners[mark, encode]

    def tell(self) -> None:
        """Tell the step that was delivered."""
        for (mark, encode), listeners in self._listeners.items():
            message = encode(mark, self._hold.moment)
            for listener in listeners:
                listener.keep(message)

    def _set_timer(self) -> None:
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(self._tick_s(), self._tick)

    def _tick(self) -> None:
        """Tell the clock while time goes by itself, as long as anybody listens."""
        self._timer = None
        if self._hold.on:
            return
        for (mark, encode), listeners in self._listeners.items():
            if mark is Mark.CLOCK:
                message = encode(mark, self._now())
                for listener in listeners:
                    listener.deliver(message)
                self._set_timer()

    def resume(self) -> None:
        """Time goes by itself again."""
        if any(mark is Mark.CLOCK for mark, _ in self._listeners):
            self._set_timer()

    def stop(self) -> None:
        """Tell nothing any more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
