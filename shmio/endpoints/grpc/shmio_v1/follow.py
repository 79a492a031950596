"""Follows one block for one subscriber; the ring in shared memory is the queue."""

from __future__ import annotations

import math
from typing import Protocol

from shmio.endpoints.grpc.shmio_v1.columns import DecodedImage
from shmio.endpoints.grpc.shmio_v1.views import MISSED, QUALITY, REASON, Selection, UpdateMessage, View, head
from shmio.endpoints.grpc.streams.encoding import field, number
from shmio.errors import SegmentError
from shmio.segment import Block, Frame, Quality

_QUALITY_BAD = number(QUALITY, 0)  # as the last field it wins over the frame's own quality


class BlockFollower(Protocol):
    """A subscriber's position in a block's frames."""

    view: View
    due_s: float
    """Event loop's time of the next possible update; infinity: it takes a new frame."""

    @property
    def begun(self) -> bool:
        """Whether the present values have been given."""

    def next(self, now_s: float) -> bytes | None:
        """Return the next serialised ``Update``, or None."""


class EveryFrame:
    """Follows every frame from the present one on, and counts those that were overwritten."""

    due_s = math.inf

    def __init__(self, view: View) -> None:
        self.view = view
        self._cursor = view.block.cursor(after=max(0, view.block.ring.head() - 1))
        self._missed = 0
        self._shown: Frame | None = None
        self._age = _AgeWatch(view)

    @property
    def begun(self) -> bool:
        """Whether the present values have been given."""
        return self._shown is not None

    def next(self, now_s: float) -> bytes | None:  # noqa: ARG002  as fast as the client takes them
        """Return the next frame's update, or one that says that the last frame is stale."""
        frame = self._cursor.poll()
        if frame is None:
            return self._age.look()
        update = b"".join(self.view.update(frame, self._shown))
        if missed := self._cursor.missed - self._missed:
            self._missed = self._cursor.missed
            update += number(MISSED, missed)
        self._shown = frame
        return update + self._age.of(frame, newest=not self._cursor.behind)


class LatestFrame:
    """Follows the newest frame that differs, at most once per interval."""

    def __init__(self, view: View, interval_s: float, deadband: float) -> None:
        self.view = view
        self.due_s = math.inf
        self._interval_s = interval_s
        self._deadband = deadband
        self._last_s = -math.inf
        self._shown: Frame | None = None
        self._sent: DecodedImage | None = None  # with a dead-band
        self._age = _AgeWatch(view)

    @property
    def begun(self) -> bool:
        """Whether the present values have been given."""
        return self._shown is not None

    def next(self, now_s: float) -> bytes | None:
        """Return the newest frame's changes, or an update that reports the last one as stale."""
        shown = self._shown
        if shown is not None and self.view.block.ring.head() == shown.number:
            return self._age.look()
        if now_s < self._last_s + self._interval_s:
            self.due_s = self._last_s + self._interval_s
            return None
        self.due_s = math.inf
        try:
            frame = self.view.block.latest()
        except SegmentError:  # overwritten during each read; there will be another
            return None
        if frame is None:
            return None
        update = self._update(frame, shown)
        recovered = self._age.told
        added = self._age.of(frame, newest=True)
        self._shown = frame
        if shown is not None and not (update.body or added or recovered or _state(frame) != _state(shown)):
            return None
        self._last_s = now_s
        return b"".join(update) + added

    def _update(self, frame: Frame, shown: Frame | None) -> UpdateMessage:
        if not (self._deadband and isinstance(self.view, Selection)):
            return self.view.update(frame, shown)
        if shown is None or self._sent is None or not shown.source_ns:
            self._sent = self.view.decode(frame)
            return self.view.update(frame)
        update, self._sent = self.view.update_beyond(frame, shown, self._sent, self._deadband)
        return update


class _AgeWatch:
    """Reports once that the last frame has become stale."""

    def __init__(self, view: View) -> None:
        self.told = False
        """Whether the last update reported it."""
        self._view = view
        self._frame: Frame | None = None

    def of(self, frame: Frame, *, newest: bool) -> bytes:
        """Return the addition to a frame's update if it is stale; empty if newer frames follow."""
        self._frame = frame
        added = aged(self._view.block, frame) if newest else b""
        self.told = bool(added)
        return added

    def look(self) -> bytes | None:
        """Return an update if the last frame has become stale since, or None."""
        frame = self._frame
        if frame is None or self.told or not (added := aged(self._view.block, frame)):
            return None
        self.told = True
        return head(self._view.number, frame) + added


def aged(block: Block, frame: Frame) -> bytes:
    """Return the addition to an update if its frame was not bad but is stale now; else empty."""
    if frame.quality is Quality.BAD:
        return b""
    quality, reason = block.assess(frame)
    return _QUALITY_BAD + field(REASON, reason.encode()) if quality is Quality.BAD else b""


def _state(frame: Frame) -> tuple[object, ...]:
    return frame.quality, frame.reason, frame.provenance, frame.incarnation
