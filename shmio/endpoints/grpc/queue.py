"""The queue between a feed and one client's stream."""

from __future__ import annotations

import asyncio
from collections import deque


class ConflatingQueue:
    """Passes every change to a client that keeps up; one that does not gets the newest value, and the loss is counted.

    ``bound`` messages may wait. One more replaces them all: a client that has fallen behind is not shown the past.
    For the event loop's thread alone, with one reader.
    """

    def __init__(self, bound: int) -> None:
        self._bound = bound
        self._messages: deque[bytes] = deque()
        self._waiter: asyncio.Future[None] | None = None
        self._ended = False
        self.dropped = 0

    def push(self, message: bytes) -> None:
        """Add a message, in place of all that wait if they are too many."""
        if len(self._messages) >= self._bound:
            self.clear()
        self._messages.append(message)
        self._wake()

    def clear(self) -> None:
        """Drop what waits."""
        self.dropped += len(self._messages)
        self._messages.clear()

    def end(self) -> None:
        """Have the reader end once it has read what waits."""
        self._ended = True
        self._wake()

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    async def pop(self) -> bytes | None:
        """The oldest message, waited for; None at the end, from where it begins anew."""
        while not self._messages:
            if self._ended:
                self._ended = False
                return None
            self._waiter = asyncio.get_running_loop().create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self._messages.popleft()
