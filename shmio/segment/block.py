"""A source's block: its layout and its frame ring, for readers and for its one writer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from shmio.errors import SegmentError
from shmio.segment._atomics import REASON_SIZE, Ring
from shmio.segment.frame import Frame, Provenance, Quality
from shmio.segment.header import cut

if TYPE_CHECKING:
    from shmio.layout.model import Layout
    from shmio.segment._atomics import FrameTuple

Bytes = bytes | bytearray | memoryview


_QUALITIES = tuple(Quality)
_PROVENANCES = tuple(Provenance)


def _frame(fields: FrameTuple) -> Frame:
    number, cycle, publish_ns, clock_ns, source_ns, incarnation, quality, provenance = fields[:8]
    event, reason, raw, effective = fields[8:]
    return Frame(
        number,
        cycle,
        publish_ns,
        clock_ns,
        source_ns,
        incarnation,
        # From shared memory: what is unknown is bad.
        _QUALITIES[quality] if quality < len(_QUALITIES) else Quality.BAD,
        _PROVENANCES[provenance] if provenance < len(_PROVENANCES) else Provenance.SIMULATED,
        event,
        reason,
        raw,
        effective,
    )


class Block:
    """Reading side of a block. Needs nothing from the writer and leaves no trace with it.

    A Block may be used from several threads; a :class:`Cursor` belongs to one.
    """

    def __init__(self, source: str, layout: Layout, ring: Ring) -> None:
        self.source = source
        self.layout = layout
        self.ring = ring

    @property
    def period_ns(self) -> int:
        """Time between two cycles."""
        return self.ring.period_ns

    @property
    def stale_ns(self) -> int:
        """Age from which a frame is bad."""
        return self.ring.stale_ns

    def latest(self) -> Frame | None:
        """A copy of the newest frame; None before the source has published its first.

        SegmentError when no stable copy could be made: the writer overtook the reader at every attempt.
        """
        fields = self.ring.latest()
        if fields is not None:
            return _frame(fields)
        if self.ring.head() == 0:
            return None
        raise SegmentError(
            f"source {self.source}: its ring turns faster than a frame can be read; raise instance.ring_mb"
        )

    def read(self, number: int) -> Frame | None:
        """A copy of one frame by its number; None when the ring does not hold it."""
        fields = self.ring.read(number)
        return None if fields is None else _frame(fields)

    def cursor(self, *, after: int | None = None) -> Cursor:
        """A stream position behind frame ``after`` (default: the newest one, so that the next frame is news)."""
        return Cursor(self, self.ring.head() if after is None else after)


class Cursor:
    """A stream reader's own position in a ring: every frame once, in order, losses counted exactly.

    >>> cursor = block.cursor()
    >>> while (frame := cursor.next(timeout_s=1.0)) is not None:
    ...     print(frame.number, cursor.missed)
    """

    def __init__(self, block: Block, after: int) -> None:
        self._block = block
        self._last = after
        self.missed = 0
        """Frames that were overwritten before this cursor read them, in all."""

    @property
    def behind(self) -> int:
        """Frames that wait to be read."""
        return max(0, self._block.ring.head() - self._last)

    def poll(self) -> Frame | None:
        """The next frame if there is one; never waits."""
        ring = self._block.ring
        while ring.head() > self._last:
            fields = ring.read(self._last + 1)
            if fields is not None:
                self._last += 1
                return _frame(fields)
            # Lapped. The oldest frames are about to go too: resume a quarter of the ring further on.
            resume = max(self._last + 1, ring.head() - ring.slot_count * 3 // 4)
            self.missed += resume - self._last
            self._last = resume
        return None

    def next(self, timeout_s: float | None = None) -> Frame | None:
        """The next frame, waited for at most ``timeout_s`` (None: for ever); None when the time is over."""
        ring = self._block.ring
        deadline_ns = None if timeout_s is None else time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            seen = ring.doorbell()  # before looking, so that no ring of the bell is lost
            frame = self.poll()
            if frame is not None:
                return frame
            rest_ns = -1 if deadline_ns is None else deadline_ns - time.monotonic_ns()
            if deadline_ns is not None and rest_ns <= 0:
                return None
            ring.wait(seen, rest_ns)

    def __iter__(self) -> Iterator[Frame]:
        while True:
            frame = self.next()
            if frame is not None:
                yield frame


class BlockWriter:
    """Writing side of a block: exactly one, in its source's process, from one thread at a time."""

    def __init__(self, block: Block, clock_ns: Callable[[int], int]) -> None:
        """``clock_ns`` turns CLOCK_MONOTONIC into the instance's clock."""
        self.block = block
        self._clock_ns = clock_ns
        self.incarnation = block.ring.begin()

    def publish(
        self,
        raw: Bytes,
        *,
        cycle: int,
        source_ns: int | None = None,
        quality: Quality = Quality.GOOD,
        provenance: Provenance = Provenance.LIVE,
        reason: str = "",
        effective: Bytes | None = None,
    ) -> int:
        """Publish one frame of ``layout.size`` bytes and wake its readers; returns its number.

        ``source_ns`` is UTC, default now; 0: no image yet. ``reason`` says why quality is not
        good; it is cut at 256 bytes.
        """
        now_ns = time.monotonic_ns()
        return self.block.ring.publish(
            raw,
            effective,
            cycle,
            now_ns,
            self._clock_ns(now_ns),
            time.time_ns() if source_ns is None else source_ns,
            quality,
            provenance,
            cut(reason, REASON_SIZE) if reason else b"",
        )
