"""Following a ring: every entry once, in order, losses counted exactly."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final, Generic, TypeVar

if TYPE_CHECKING:
    from shmio.segment._atomics import FrameTuple, Ring

Entry = TypeVar("Entry")

TURN_NS: Final = 1_000_000_000
"""How often who waits looks by itself: the bell of a block's end is lost if the supervisor dies before it."""


class Cursor(Generic[Entry]):
    """A reader's own position in a ring of frames or events; for one thread.

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
        """Entries that were overwritten before this cursor read them, in all."""

    @property
    def last(self) -> int:
        """Number of the last entry read, or counted as missed."""
        return self._last

    @property
    def behind(self) -> int:
        """Entries that wait to be read."""
        return max(0, self._ring.head() - self._last)

    def poll(self) -> Entry | None:
        """The next entry if there is one; never waits."""
        ring = self._ring
        margin = 0
        while ring.head() > self._last:
            fields = ring.read(self._last + 1)
            if fields is not None:
                self._last += 1
                return self._decode(fields)
            # Lapped. Resume with the oldest entry that there is, and further on each time that the writer is faster.
            resume = max(self._last + 1, ring.head() - ring.slot_count + margin)
            margin = min(2 * margin + 1, ring.slot_count // 2)
            self.missed += resume - self._last
            self._last = resume
        return None

    def next(self, timeout_s: float | None = None) -> Entry | None:
        """The next entry, waited for at most ``timeout_s`` (None: for ever).

        None when the time is over, or at once when the block was retired by a reload and all of it has been read.
        """
        ring = self._ring
        deadline_ns = None if timeout_s is None else time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            seen = ring.doorbell()  # before looking, so that no ring of the bell is lost
            retired = self._retired()  # before looking too: what was published before the end is still read
            entry = self.poll()
            if entry is not None or retired:
                return entry
            rest_ns = TURN_NS if deadline_ns is None else min(TURN_NS, deadline_ns - time.monotonic_ns())
            if rest_ns <= 0:
                return None
            ring.wait(seen, rest_ns)

    def __iter__(self) -> Iterator[Entry]:
        """All entries to come; ends when the block is retired."""
        while True:
            entry = self.next()
            if entry is not None:
                yield entry
            elif self._retired():
                return
