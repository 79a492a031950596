"""How far a thread is in what it follows, for an event loop that waits for it."""

from __future__ import annotations

import asyncio
import threading


class Progress:
    """The number of the last event whose messages are on their way to the event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop, number: int) -> None:
        self._loop = loop
        self._number = number
        self._asked: tuple[int, asyncio.Future[None]] | None = None
        self._turn = threading.Lock()

    async def reached(self, number: int) -> None:
        """Wait until the messages of all events up to this one are delivered; for one at a time."""
        told = self._loop.create_future()
        with self._turn:
            if self._number < number:
                self._asked = number, told
            else:
                self._loop.call_soon(_set, told)  # behind what is on its way
        await told

    def tell(self, number: int) -> None:
        """All up to this event is on its way; from the thread."""
        with self._turn:
            self._number = number
            if self._asked is not None and self._asked[0] <= number:
                self._loop.call_soon_threadsafe(_set, self._asked[1])
                self._asked = None


def _set(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
