"""Follows the events of one block and passes them on, a few at a time."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Final

from shmio.endpoints.grpc.streams.wakeups import WakeUps
from shmio.segment import Block, Event

log = logging.getLogger("shmio.grpc")

BATCH: Final = 32
"""Events that are processed before the event loop serves the streams."""


class EventFollower:
    """Reads a block's events whenever the block wakes the event loop. For that loop's thread."""

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
        """Prepare to follow events from now on; see :meth:`start`.

        Args:
            block: The block whose events are followed.
            wake_ups: Wakes this follower.
            on_event: Called with each event.
            on_batch_end: Called after each batch of events.
            missed: Called with the number of events that were overwritten before they were read.
            retired: Called after the last event of a block that has retired.

        """
        self._block = block
        self._wake_ups = wake_ups
        self._on_event, self._on_batch_end, self._on_missed, self._retired = on_event, on_batch_end, missed, retired
        self._loop = asyncio.get_running_loop()
        self._cursor = block.events.cursor()
        self._missed = 0  # events, as last reported
        self._again = False  # whether another look is scheduled
        self.alive = False
        """Whether events are being followed."""

    def start(self) -> None:
        """Start following events."""
        self.alive = True
        self._wake_ups.join(self._block, self._look, patient=True)

    def stop(self) -> None:
        """Stop following events."""
        if self.alive:
            self.alive = False
            self._wake_ups.leave(self._block, self._look)

    def catch_up(self) -> None:
        """Process all events that there are so far."""
        newest = self._block.events.head()
        while self.alive and self._cursor.last < newest:
            self._look()

    def _look(self) -> None:
        if not self.alive:
            return  # stopped during the wake-up
        try:
            self._follow()
        except Exception:
            log.exception("the events of %s cannot be followed", self._block.source)
            self.stop()

    def _look_again(self) -> None:
        self._again = False
        self._look()

    def _follow(self) -> None:
        retired = self._block.retired  # before reading: events before the end are still processed
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
