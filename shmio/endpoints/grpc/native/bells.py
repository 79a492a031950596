"""Wakes streams in the event loop when a block has a new frame: a thread for each block that somebody follows."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from shmio.segment import Block

WAIT_NS: Final = 200_000_000
"""Longest time between two rings: streams look at the age of what they have shown."""

Ring = Callable[[], None]


class Bell:
    """Rings for one block. ``join`` and ``leave`` belong to the event loop's thread."""

    def __init__(self, block: Block) -> None:
        self.listeners: set[Ring] = set()
        self._block = block
        self._loop = asyncio.get_running_loop()
        self._told = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=f"bell-{block.source}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ring no more; the thread ends within ``WAIT_NS``."""
        self._stopping = True

    def _tell(self) -> None:
        self._told.set()  # before looking: what comes from now on rings again
        for ring in tuple(self.listeners):
            ring()

    def _run(self) -> None:
        ring = self._block.ring
        wait_ns = min(WAIT_NS, self._block.stale_ns)
        with suppress(RuntimeError):  # the event loop is closed
            while not self._stopping:
                seen = ring.doorbell()  # before it is told, so that no frame is lost
                self._told.clear()
                self._loop.call_soon_threadsafe(self._tell)
                if self._block.retired:
                    return
                self._told.wait(WAIT_NS / 1e9)  # a loop that is busy is not rung for every frame
                ring.wait(seen, wait_ns)


class Bells:
    """Those of all blocks that are followed; for the event loop's thread."""

    def __init__(self) -> None:
        self._bells: dict[int, Bell] = {}

    def join(self, block: Block, ring: Ring) -> None:
        """Have ``ring`` called when there is a frame, and now and then."""
        bell = self._bells.get(block.section)
        if bell is None:
            bell = self._bells[block.section] = Bell(block)
        bell.listeners.add(ring)

    def leave(self, block: Block, ring: Ring) -> None:
        """The last one takes the thread with it."""
        bell = self._bells[block.section]
        bell.listeners.discard(ring)
        if not bell.listeners:
            bell.stop()
            del self._bells[block.section]
