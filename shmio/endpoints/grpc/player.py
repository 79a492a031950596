"""Makes steps by itself, at a pace."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Final

from shmio.errors import ShmioError

LATE_S: Final = 0.5
"""What is late is caught up with, up to this."""

log = logging.getLogger("shmio.grpc")


class Player:
    """For the event loop's thread."""

    def __init__(self, make: Callable[[int | None], Awaitable[object]], step_size_ns: Callable[[], int]) -> None:
        """``make``: makes a step of so many ns, or of the step size; a ShmioError is logged, and it goes on."""
        self.dt_ns: int | None = None
        """Of each step; None: the step size."""
        self.rate = 1.0
        """How many times as fast as real time."""
        self._make = make
        self._step_size_ns = step_size_ns
        self._loop = asyncio.get_running_loop()
        self._task: asyncio.Task[None] | None = None
        self._woken = asyncio.Event()

    @property
    def on(self) -> bool:
        """Whether it plays."""
        return self._task is not None

    @property
    def alive(self) -> bool:
        """Whether it plays if it should."""
        return self._task is None or not self._task.done()

    def begin(self) -> None:
        """Play, unless it does."""
        if self._task is None:
            self._task = self._loop.create_task(self._play())

    async def end(self) -> None:
        """Play no more; return when the last step is over."""
        task, self._task = self._task, None
        self._woken.set()
        if task is not None:
            await task

    async def break_off(self) -> None:
        """End in the middle of a step; it still counts as on."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _play(self) -> None:
        due_s = self._loop.time()
        reason = ""
        self._woken.clear()
        while self._task is asyncio.current_task():
            try:
                await self._make(self.dt_ns)
                reason = ""
            except ShmioError as error:
                last, reason = reason, str(error)
                if reason != last:
                    log.warning("playing: %s", reason)
            dt_s = (self.dt_ns or self._step_size_ns()) / 1e9
            due_s = max(due_s + dt_s / self.rate, self._loop.time() - LATE_S)
            with suppress(TimeoutError):  # others have their turn even if it is late
                await asyncio.wait_for(self._woken.wait(), max(0.0, due_s - self._loop.time()))
