"""What a source publishes: its device's images, and what injections make of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from shmio.connectors.injection.layers import LayerStack
from shmio.segment import BlockWriter, Provenance, Quality, Record, Stamp

EXTRA_FRAMES: Final = 4
"""So many frames a period may come between those of the cycles: rings, which hold 8 s of cycles, must last for all."""


class Image(NamedTuple):
    """An image with all that is told of it; times as in :meth:`BlockWriter.publish`."""

    raw: bytes
    cycle: int
    source_ns: int
    quality: Quality
    provenance: Provenance
    reason: str
    asked_ns: int | None = None
    shown: bytes | None = None
    """What consumers saw of it when it was recorded, if that was something else than ``raw``."""
    at: Stamp | None = None
    """When it is to be published; default: now."""

    @property
    def base(self) -> bytes:
        """What the injections of this instance are laid over."""
        return self.raw if self.shown is None else self.shown


class Output:
    """Publishes images, and the last one again when injections have changed; threads take turns at it.

    Changes that come faster than ``EXTRA_FRAMES`` a period share a frame. What is to be told of them follows it.
    """

    def __init__(self, writer: BlockWriter, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.writer = writer
        self.injections = LayerStack(writer.block.layout.size)
        """To be changed, and :meth:`show` called then, with ``turn`` held."""
        self.turn = threading.Lock()
        self.advance: Callable[[Image], Iterable[Record]] | None = None
        """Called with each next image before it is published; what it returns is told after it."""
        self._now_ns = now_ns
        self._gap_ns = writer.block.period_ns // EXTRA_FRAMES
        self._next_ns = 0
        self._changed = False
        self._owed: list[Record] = []
        self._last = self._predecessors()

    def _predecessors(self) -> Image | None:
        last = self.writer.block.latest()
        if last is None:
            return None
        asked_ns = last.publish_ns - 1000 * last.delay_us
        return Image(last.raw, last.cycle, last.source_ns, last.quality, last.provenance, last.reason, asked_ns)

    @property
    def raw(self) -> bytes:
        """The image published last, by the process before this one at first; zeros if there is none."""
        return bytes(self.writer.block.layout.size) if self._last is None else self._last.raw

    @property
    def base(self) -> bytes:
        """What the injections are laid over: :attr:`raw`, unless a recording has something else."""
        return self.raw if self._last is None else self._last.base

    @property
    def cycle(self) -> int:
        """The cycle of that image; -1: there is none."""
        return -1 if self._last is None else self._last.cycle

    @property
    def source_ns(self) -> int:
        """When the device had that image, ns since 1970; 0: none has come from it yet."""
        return 0 if self._last is None else self._last.source_ns

    @property
    def next_ns(self) -> int:
        """When the next frame between two cycles may come, on the clock given."""
        return self._next_ns

    @property
    def patience_ns(self) -> int:
        """How long changes wait for their frame still, until :meth:`flush`; negative: there are none."""
        return max(0, self._next_ns - self._now_ns()) if self._changed else -1

    def publish(self, image: Image) -> None:
        """Publish the next image."""
        with self.turn:
            self._last = image
            if self.advance is not None:
                self._owed += self.advance(image)
            self._publish(image.at)

    def resume(self, image: Image) -> None:
        """Go on from an image that was published already."""
        with self.turn:
            self._last = image

    def show(self, records: Iterable[Record]) -> None:
        """Have consumers see the injections as they are by now, then tell ``records``; with ``turn`` held."""
        self._owed += records
        self._changed = True
        if self._now_ns() >= self._next_ns:
            self._publish()

    def flush(self) -> None:
        """Show what has waited long enough."""
        with self.turn:
            if self._changed and self._now_ns() >= self._next_ns:
                self._publish()

    def _publish(self, at: Stamp | None = None) -> None:
        if self._last is not None:
            raw, cycle, source_ns, quality, provenance, reason, asked_ns, shown, _ = self._last
            effective = self.injections.effective(self._last.base)
            self.writer.publish(
                raw,
                cycle=cycle,
                source_ns=source_ns,
                quality=quality,
                provenance=provenance,
                reason=reason,
                effective=shown if effective is None else effective,
                asked_ns=asked_ns,
                at=at,
            )
        owed, self._owed, self._changed = self._owed, [], False
        for record in owed:
            self.writer.event(record)
        self._next_ns = self._now_ns() + self._gap_ns
