"""Wakes the event loop when a block has something new: one bell for each block, whoever listens."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

from shmio.segment import Block
from shmio.segment.relay import TURN_NS, Relay, WakeSource

Callback = Callable[[], object]

REST_S: Final = 0.005
"""So long a bell is not heard when nobody listens to it but those that have time."""


class WakeUp:
    """Rings for one word in shared memory, at first too, and now and then. For the event loop's thread."""

    def __init__(self, word: WakeSource, name: str, turn_ns: int = TURN_NS) -> None:
        """``turn_ns``: it rings after so long without a ring, too."""
        self.listeners: dict[Callback, None] = {}  # in the order in which they came
        self.patient: set[Callback] = set()
        """Those of them that have time for a while."""
        self._loop = asyncio.get_running_loop()
        self._relay = Relay(word, name, turn_ns)
        self._resting: asyncio.TimerHandle | None = None
        self.unmute()

    @property
    def alive(self) -> bool:
        """Whether it rings, or is about to end."""
        return self._relay.alive

    def mute(self) -> None:
        """Ring not, whatever happens, until :meth:`unmute`; which rings. Costs nobody anything meanwhile."""
        self._loop.remove_reader(self._relay.descriptor)

    def unmute(self) -> None:
        """Ring again."""
        self._loop.add_reader(self._relay.descriptor, self._ring)

    def rest(self) -> None:
        """Ring not for a while, if all listeners have time."""
        if self._resting is None and self.patient >= self.listeners.keys():
            self.mute()
            self._resting = self._loop.call_later(REST_S, self._rested)

    def _rested(self) -> None:
        """Ring for what was heard, and left, before."""
        self.resume()
        for ring in tuple(self.listeners):
            ring()

    def resume(self) -> None:
        """Rest no more."""
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
            self.unmute()

    def stop(self) -> None:
        """Ring no more."""
        self.resume()
        self.mute()
        self._relay.stop()

    def join(self) -> None:
        """Wait until nothing of it is left, after :meth:`stop`."""
        self._relay.join()

    def _ring(self) -> None:
        self._relay.heard()
        for ring in tuple(self.listeners):
            ring()


class WakeUps:
    """Those of all blocks that are followed; for the event loop's thread."""

    def __init__(self) -> None:
        self._wake_ups: dict[int, WakeUp] = {}
        self._stopped: list[WakeUp] = []

    def join(self, block: Block, ring: Callback, *, patient: bool = False) -> None:
        """Have ``ring`` called when there is a frame or an event, and now and then.

        ``patient``: if nobody else listens but who :meth:`rest`, it has time, too.
        """
        bell = self._wake_ups.get(block.section)
        if bell is None:
            bell = WakeUp(block.ring, f"bell-{block.source}", min(TURN_NS, block.stale_ns))
            self._wake_ups[block.section] = bell
        bell.listeners[ring] = None
        if patient:
            bell.patient.add(ring)
        else:
            bell.resume()

    def rest(self, block: Block, ring: Callback) -> None:
        """Have ``ring`` not called for a while; it still is if others listen that have no time."""
        if bell := self._wake_ups.get(block.section):
            bell.patient.add(ring)
            bell.rest()

    def resume(self, block: Block, ring: Callback) -> None:
        """Have it called again."""
        if bell := self._wake_ups.get(block.section):
            bell.patient.discard(ring)
            bell.resume()

    def leave(self, block: Block, ring: Callback) -> None:
        """The last one takes the bell with it."""
        bell = self._wake_ups.get(block.section)
        if bell is None:
            return  # all are closed
        bell.listeners.pop(ring, None)
        bell.patient.discard(ring)
        if not bell.listeners:
            bell.stop()
            del self._wake_ups[block.section]
            self._stopped = [stopped for stopped in self._stopped if stopped.alive] + [bell]

    def close(self) -> None:
        """Ring no more, and wait until nothing is left of it."""
        for bell in self._wake_ups.values():
            bell.stop()
        for bell in (*self._wake_ups.values(), *self._stopped):
            bell.join()
        self._wake_ups.clear()
