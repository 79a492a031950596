"""Publishes a source's images with its injections applied."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from shmio.connectors.injection.layers import LayerStack
from shmio.segment import BlockWriter, Provenance, Quality, Record, Stamp

EXTRA_FRAMES: Final = 4
"""Most frames per period in addition to the cycle's own.

Rings are sized for all of them over 8 s.
"""


class Image(NamedTuple):
    """An image of the block with its metadata; times as in :meth:`BlockWriter.publish`."""

    raw: bytes
    cycle: int
    source_ns: int
    quality: Quality
    provenance: Provenance
    reason: str
    asked_ns: int | None = None
    shown: bytes | None = None
    """The image that consumers saw when it was recorded, if it differed from ``raw``."""
    at: Stamp | None = None
    """When to publish the image; default: now."""

    @property
    def base(self) -> bytes:
        """The image to which this instance's injections are applied."""
        return self.raw if self.shown is None else self.shown


class Output:
    """Publishes images, and republishes the last one when injections change.

    Several threads may call it; ``turn`` serialises them. Changes that come faster than
    ``EXTRA_FRAMES`` per period share a frame. Events about a change are published after the frame
    that shows it.
    """

    def __init__(self, writer: BlockWriter, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.writer = writer
        self.injections = LayerStack(writer.block.layout.size)
        """The layers of this source.

        Hold ``turn`` while you change them, then call :meth:`show`.
        """
        self.turn = threading.Lock()
        self.advance: Callable[[Image], Iterable[Record]] | None = None
        """Called with each new image before it is published.

        The events that it returns follow the frame.
        """
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
        """The bytes published last, at first by the previous process of the source.

        Zeros if there are none.
        """
        return bytes(self.writer.block.layout.size) if self._last is None else self._last.raw

    @property
    def base(self) -> bytes:
        """Image beneath injections: :attr:`raw`, or the recorded image in a replay."""
        return self.raw if self._last is None else self._last.base

    @property
    def cycle(self) -> int:
        """The cycle of the image published last; -1 if there is none."""
        return -1 if self._last is None else self._last.cycle

    @property
    def source_ns(self) -> int:
        """When the device had the image published last, ns since 1970.

        0 if none came from it yet.
        """
        return 0 if self._last is None else self._last.source_ns

    @property
    def next_ns(self) -> int:
        """The earliest time of the next frame between two cycles, ns on the given clock."""
        return self._next_ns

    @property
    def patience_ns(self) -> int:
        """How long changes still wait for :meth:`flush`, in ns; negative if there are none."""
        return max(0, self._next_ns - self._now_ns()) if self._changed else -1

    def publish(self, image: Image) -> None:
        """Publish the next image."""
        with self.turn:
            self._last = image
            if self.advance is not None:
                self._owed += self.advance(image)
            self._publish(image.at)

    def resume(self, image: Image) -> None:
        """Continue from an image that the previous process has published."""
        with self.turn:
            self._last = image

    def show(self, records: Iterable[Record]) -> None:
        """Publish the present state of the injections, then ``records``. The caller holds ``turn``.

        If the last frame is too recent, the changes wait for :meth:`flush`.
        """
        self._owed += records
        self._changed = True
        if self._now_ns() >= self._next_ns:
            self._publish()

    def flush(self) -> None:
        """Publish pending changes once their time has come."""
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
