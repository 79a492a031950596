"""Makes steps in the event loop, which goes on meanwhile."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import closing
from typing import Final

from shmio.endpoints.grpc.bells import Bell, Bells
from shmio.segment.answers import Wait
from shmio.segment.clock import ClockPage
from shmio.segment.coordinator import Coordinator, Step

BRIEF_NS: Final = 500_000
"""So long the event loop stands still for sources that answer at once: to be told by a thread takes about as long."""


class Driver:
    """What :meth:`Coordinator.step` is to a thread; for the event loop's thread, one step at a time."""

    def __init__(self, coordinator: Coordinator, clock: ClockPage, bells: Bells) -> None:
        self._coordinator = coordinator
        self._clock = clock
        self._bells = bells
        self._delivered: Bell | None = None  # nobody else delivers steps, as a rule

    async def step(self, dt_ns: int | None) -> Step:
        """Errors as of :meth:`Coordinator.step`; one that is cancelled is broken off."""
        still_ns = time.monotonic_ns() + BRIEF_NS
        with closing(self._coordinator.stepping(dt_ns)) as stepping:
            while True:
                try:
                    wait = next(stepping)
                except StopIteration as over:
                    step: Step = over.value
                    return step
                if not _brief(wait, still_ns - time.monotonic_ns()):
                    await self._stay(wait)

    def stop(self) -> None:
        """Wait for nobody any more."""
        if self._delivered is not None:
            self._delivered.stop()
            self._delivered.join()

    async def _stay(self, wait: Wait) -> None:
        """Until its bell rings, which it does now and then in any case."""
        rung = asyncio.get_running_loop().create_future()

        def ring() -> None:
            if not rung.done():
                rung.set_result(None)

        leave = self._listen(wait, ring)
        try:
            if wait.seen == (wait.block.ring.doorbell() if wait.block else self._clock.delivered_bell.value()):
                await rung
        finally:
            leave()

    def _listen(self, wait: Wait, ring: Callable[[], None]) -> Callable[[], object]:
        block = wait.block
        if block is not None:
            self._bells.join(block, ring)
            return lambda: self._bells.leave(block, ring)
        bell = self._delivered = self._delivered or Bell(self._clock.delivered_bell, "delivered")
        bell.listeners[ring] = None
        return lambda: bell.listeners.pop(ring)


def _brief(wait: Wait, rest_ns: int) -> bool:
    """Wait in the event loop's own thread, at most so long; whether the block's bell has rung."""
    if wait.block is None or rest_ns <= 0:
        return False
    return wait.block.ring.wait(wait.seen, min(rest_ns, wait.rest_ns)) != wait.seen
