"""Follow a ring: read every entry once, in order, and count losses exactly."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final, Generic, TypeVar

if TYPE_CHECKING:
    from shmio.segment._atomics import FrameTuple, Ring

Entry = TypeVar("Entry")

TURN_NS: Final = 1_000_000_000
"""How often a waiting reader polls: if the supervisor dies, the doorbell for a block's end is never rung."""


class Cursor(Generic[Entry]):
    """A reader's position in a ring of frames or events. Use it from one thread.

    >>> cursor = block.cursor()
    >>> while (frame := cursor.next(timeout_s=1.0)) is not None:
    ...     print(frame.number, cursor.missed)
    """

    def __init__(
        self, ring: Ring, decode: Callable[[FrameTuple], Entry], after: int, retired: Callable[[], bool]
    ) -> None:
        self._ring = ring
        self._decode = decode
        self._retired = retired
        self._last = after
        self.missed = 0
        """Total number of entries that were overwritten or skipped before this cursor read them."""
        self._reported = 0

    @property
    def last(self) -> int:
        """Number of the last entry read, or counted as missed."""
        return self._last

    @property
    def behind(self) -> int:
        """Number of entries that are not read yet."""
        return max(0, self._ring.head() - self._last)

    @property
    def ended(self) -> bool:
        """Whether a reload has retired the block, and all its entries have been read."""
        return self._retired() and not self.behind  # in this order: nothing is published after the end

    def take_missed(self) -> int:
        """Return how many entries were missed since the last call."""
        missed, self._reported = self.missed - self._reported, self.missed
        return missed

    def resume(self, *, after: int) -> None:
        """Continue with the entry behind this number; those in between do not count as missed."""
        self._last = after

    def poll(self) -> Entry | None:
        """Return the next entry if there is one, without waiting."""
        ring = self._ring
        margin = 0
        while ring.head() > self._last:
            fields = ring.read(self._last + 1)
            if fields is not None:
                self._last += 1
                return self._decode(fields)
            # Lapped: resume with the oldest entry, and further ahead each time the writer is faster.
            resume = max(self._last + 1, ring.head() - ring.slot_count + margin)
            margin = min(2 * margin + 1, ring.slot_count // 2)
            self.missed += resume - self._last
            self._last = resume
        return None

    def next(self, timeout_s: float | None = None) -> Entry | None:
        """Return the next entry, waiting at most ``timeout_s`` (None: forever).

        Returns:
            The entry. None if none came in time, or if a reload has retired the block and all of it
            has been read.
        """
        ring = self._ring
        deadline_ns = None if timeout_s is None else time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            seen = ring.doorbell()  # before polling, so that no ring is lost
            retired = self._retired()  # also before polling: what was published before the end is still read
            entry = self.poll()
            if entry is not None or retired:
                return entry
            rest_ns = TURN_NS if deadline_ns is None else min(TURN_NS, deadline_ns - time.monotonic_ns())
            if rest_ns <= 0:
                return None
            ring.wait(seen, rest_ns)

    def __iter__(self) -> Iterator[Entry]:
        """Iterate over all entries to come, until the block is retired."""
        while True:
            entry = self.next()
            if entry is not None:
                yield entry
            elif self._retired():
                return
