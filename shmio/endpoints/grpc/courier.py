"""From a thread to the event loop: calls in their order, with one wake-up for as many as have come meanwhile."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any


class Courier:
    """Of one thread. To wake the loop costs more than what it then does: a busy one is not woken for each call."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._waiting: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self._called = False

    def post(self, call: Callable[..., object], *arguments: object) -> None:
        """Have the loop call it, behind all that was posted before. RuntimeError: the loop is closed."""
        self._waiting.append((call, arguments))  # first, so that a delivery that has begun takes it
        if not self._called:
            self._called = True
            self._loop.call_soon_threadsafe(self._deliver)

    def _deliver(self) -> None:
        self._called = False  # first, so that what comes from now on calls again
        try:
            for _ in range(len(self._waiting)):
                call, arguments = self._waiting.popleft()
                call(*arguments)
        finally:
            if self._waiting and not self._called:  # one has failed, or another has just come
                self._called = True
                self._loop.call_soon(self._deliver)
