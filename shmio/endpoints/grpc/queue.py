"""The queue between a feed and one client's stream."""

from __future__ import annotations

import asyncio
from collections import deque


class ConflatingQueue:
    """Holds the newest ``bound`` messages; a slow reader loses the oldest ones, and they are counted.

    For the event loop's thread alone, with one reader.
    """

    def __init__(self, bound: int) -> None:
        self._messages: deque[bytes] = deque(maxlen=bound)
        self._waiter: asyncio.Future[None] | None = None
        self.dropped = 0

    def push(self, message: bytes) -> None:
        """Add a message, in place of the oldest if the queue is full."""
        if len(self._messages) == self._messages.maxlen:
            self.dropped += 1
        self._messages.append(message)
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    async def pop(self) -> bytes:
        """The oldest message, waited for."""
        while not self._messages:
            self._waiter = asyncio.get_running_loop().create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self._messages.popleft()
