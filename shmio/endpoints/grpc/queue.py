"""The queues between what a source says and one client's stream."""

from __future__ import annotations

import asyncio
from collections import deque


class _Queue:
    """Messages in order; for the event loop's thread alone, with one reader."""

    def __init__(self) -> None:
        self._messages: deque[bytes] = deque()
        self._size = 0
        self._waiter: asyncio.Future[None] | None = None
        self._ended = False
        self.dropped = 0

    def clear(self) -> None:
        """Drop what waits."""
        self.dropped += len(self._messages)
        self._messages.clear()
        self._size = 0

    def end(self) -> None:
        """Have the reader end once it has read what waits."""
        self._ended = True
        self._wake()

    def _add(self, message: bytes) -> None:
        self._messages.append(message)
        self._size += len(message)
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
        message = self._messages.popleft()
        self._size -= len(message)
        return message


class ConflatingQueue(_Queue):
    """For states: every change for a client that keeps up; for one that does not the newest value, the loss is counted.

    ``bound`` messages may wait. One more replaces them all: a client that has fallen behind is not shown the past.
    """

    def __init__(self, bound: int) -> None:
        super().__init__()
        self._bound = bound

    def push(self, message: bytes) -> None:
        """Add a message, in place of all that wait if they are too many."""
        if len(self._messages) >= self._bound:
            self.clear()
        self._add(message)


class UnbrokenQueue(_Queue):
    """For events, of which none replaces another: all of them up to the one that did not fit, and then the end.

    ``bound`` messages may wait, and ``bound_bytes`` of them, or a single one that is longer.
    """

    def __init__(self, bound: int, bound_bytes: int) -> None:
        super().__init__()
        self._bound, self._bound_bytes = bound, bound_bytes
        self.failure = ""
        """Why it ended; empty: it did not."""

    def push(self, message: bytes) -> None:
        """Add a message, or fail if there is no room."""
        waiting = len(self._messages)
        if waiting and (waiting >= self._bound or self._size + len(message) > self._bound_bytes):
            self.fail(f"{waiting} messages wait to be read: the client is too slow for what is written")
        if self.failure:
            self.dropped += 1
        else:
            self._add(message)

    def fail(self, reason: str) -> None:
        """End at once; what waits is dropped, and all that comes."""
        self.failure = self.failure or reason
        self.clear()
        self.end()
