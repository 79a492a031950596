"""The one follower of a block's events: hands them over as they come, a few at a time."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Final

from shmio.endpoints.grpc.streams.wakeups import WakeUps
from shmio.segment import Block, Event

log = logging.getLogger("shmio.grpc")

BATCH: Final = 32
"""Most events that are looked at at once, so that streams get their turn in between."""


class EventFollower:
    """Listens to one block's bell. For the event loop's thread."""

    def __init__(
        self,
        block: Block,
        wake_ups: WakeUps,
        *,
        on_event: Callable[[Event], None],
        on_batch_end: Callable[[], None],
        missed: Callable[[int], None],
        retired: Callable[[], None],
    ) -> None:
        """``heed`` is called with each event, ``heeded`` after some of them.

        ``missed``: with how many were overwritten before they were read; ``retired``: when the block's last was heeded.
        """
        self._block = block
        self._wake_ups = wake_ups
        self._on_event, self._on_batch_end, self._on_missed, self._retired = on_event, on_batch_end, missed, retired
        self._loop = asyncio.get_running_loop()
        self._cursor = block.events.cursor()
        self._missed = 0  # events, as last told
        self._again = False  # whether the loop is about to look without a bell
        self.alive = False
        """Whether it listens."""

    def start(self) -> None:
        """Begin to listen."""
        self.alive = True
        self._wake_ups.join(self._block, self._look, patient=True)

    def stop(self) -> None:
        """Listen no more."""
        if self.alive:
            self.alive = False
            self._wake_ups.leave(self._block, self._look)

    def catch_up(self) -> None:
        """Hand over what has been told so far."""
        newest = self._block.events.head()
        while self.alive and self._cursor.last < newest:
            self._look()

    def _look(self) -> None:
        if not self.alive:
            return  # it has left while the bell rang
        try:
            self._follow()
        except Exception:
            log.exception("the events of %s cannot be followed", self._block.source)
            self.stop()

    def _look_again(self) -> None:
        self._again = False
        self._look()

    def _follow(self) -> None:
        retired = self._block.retired  # before looking: what was told before the end is still heeded
        for count in range(BATCH):
            event = self._cursor.poll()
            if (missed := self._cursor.missed - self._missed) > 0:
                self._missed += missed
                self._on_missed(missed)
            if event is not None:
                self._on_event(event)
                continue
            if count:
                self._on_batch_end()
            if retired:
                self.stop()
                self._retired()
            return
        self._on_batch_end()
        if not self._again:
            self._again = True
            self._loop.call_soon(self._look_again)
