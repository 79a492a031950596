"""Follows one block for one subscriber. The ring in shared memory is the queue: nothing waits in this process."""

from __future__ import annotations

import math
from typing import Protocol

from shmio.endpoints.grpc.shmio_v1.columns import DecodedImage
from shmio.endpoints.grpc.shmio_v1.views import MISSED, QUALITY, REASON, Selection, UpdateMessage, View, head
from shmio.endpoints.grpc.streams.encoding import field, number
from shmio.errors import SegmentError
from shmio.segment import Block, Frame, Quality

_QUALITY_BAD = number(QUALITY, 0)  # said last it holds, also where the frame was good when it was published


class BlockFollower(Protocol):
    """A subscriber's place in a block."""

    view: View
    due_s: float
    """Event loop's time before which :meth:`next` gives nothing; infinity: only a frame makes it."""

    @property
    def begun(self) -> bool:
        """Whether the present values have been given."""

    def next(self, now_s: float) -> bytes | None:
        """The next serialised ``Update``, if there is one."""


class EveryFrame:
    """All frames from the present one on; what was overwritten before the client took it is counted."""

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
        """The next frame, or what has become of the last one."""
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
    """The newest frame whenever there is one that shows something else; not more often than wanted."""

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
        """What differs in the newest frame from what was sent last; or what has become of that."""
        shown = self._shown
        if shown is not None and self.view.block.ring.head() == shown.number:
            return self._age.look()
        if now_s < self._last_s + self._interval_s:
            self.due_s = self._last_s + self._interval_s
            return None
        self.due_s = math.inf
        try:
            frame = self.view.block.latest()
        except SegmentError:  # overwritten while it was read, again and again; there will be another
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
    """Says once that what was shown last has become too old."""

    def __init__(self, view: View) -> None:
        self.told = False
        """Whether the last update has said so."""
        self._view = view
        self._frame: Frame | None = None

    def of(self, frame: Frame, *, newest: bool) -> bytes:
        """What to add to a frame's update if it is too old already; nothing of one that others follow."""
        self._frame = frame
        added = aged(self._view.block, frame) if newest else b""
        self.told = bool(added)
        return added

    def look(self) -> bytes | None:
        """An update, if the frame has become too old since."""
        frame = self._frame
        if frame is None or self.told or not (added := aged(self._view.block, frame)):
            return None
        self.told = True
        return head(self._view.number, frame) + added


def aged(block: Block, frame: Frame) -> bytes:
    """What to add to the update of a frame that was good, or uncertain, and is too old by now; else nothing."""
    if frame.quality is Quality.BAD:
        return b""
    quality, reason = block.assess(frame)
    return _QUALITY_BAD + field(REASON, reason.encode()) if quality is Quality.BAD else b""


def _state(frame: Frame) -> tuple[object, ...]:
    return frame.quality, frame.reason, frame.provenance, frame.incarnation
