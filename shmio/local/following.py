"""Iterate over what happens in several blocks of a local instance."""

from __future__ import annotations

import math
import select
import threading
import time
import weakref
from collections.abc import Callable
from typing import Final, Generic, Self, TypeVar

from shmio.segment.block import Block
from shmio.segment.doorbell import Relay

TURN_S: Final = 0.2
"""How often a waiting iterator checks that the instance still runs, and whether it was closed."""

Item = TypeVar("Item")


class Following(Generic[Item]):
    """An iterator for one thread, which any thread may close.

    A relay for each followed block wakes it, for frames and events alike.
    """

    def __init__(self, check_running: Callable[[], None]) -> None:
        """``check_running`` raises NotRunningError when the instance has stopped."""
        self._check_running = check_running
        self._turn = threading.Lock()  # held while the mapped memory is read: close waits for it
        self._relays: dict[int, Relay] = {}  # by the block's section
        self._stop = weakref.finalize(self, _stop, self._relays)  # also for a program that does not close it
        self._closed = False
        self._due_s = math.inf
        """When to look again although nothing has happened, in s of the monotonic clock."""
        self._checked_s = time.monotonic()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Item:
        while True:
            with self._turn:
                if self._closed:
                    raise StopIteration
                for relay in self._relays.values():
                    relay.heard()  # before looking
                found = self._take()
                poll = select.poll()
                for relay in self._relays.values():
                    poll.register(relay.descriptor, select.POLLIN)
            if found is not None:
                return found
            now_s = time.monotonic()
            if now_s > self._checked_s + TURN_S:
                self._check_running()
                self._checked_s = now_s
            poll.poll(1000 * max(0.0, min(TURN_S, self._due_s - now_s)))

    def _take(self) -> Item | None:
        """Return the next item if there is one. StopIteration: none will come."""
        raise NotImplementedError

    def _follow(self, block: Block) -> None:
        """Be woken by a block from now on."""
        self._relays[block.section] = Relay(block.ring, f"following-{block.source}", round(TURN_S * 1e9))

    def _leave(self, block: Block) -> None:
        """Be woken by a block no more."""
        self._relays.pop(block.section).join()

    def end(self) -> None:
        """End the iteration, and wait until nothing reads the mapped memory."""
        self._closed = True
        with self._turn:
            self._stop()


def _stop(relays: dict[int, Relay]) -> None:
    """Stop relays, and wait until their threads have ended."""
    for relay in relays.values():
        relay.stop()
    for relay in relays.values():
        relay.join()
    relays.clear()
