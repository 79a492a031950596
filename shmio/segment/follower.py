"""Follow a block: its frames in order, how many were missed, and when its quality changes."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import Final

from shmio.model.values import Quality
from shmio.segment.block import Block, decode_frame
from shmio.segment.cursor import Cursor
from shmio.segment.frame import Frame


class QualityChange(Enum):
    """How a block's quality has changed since the frame before."""

    NONE = "none"
    DETAIL = "detail"
    """Another quality or reason, but bad as before, or not bad as before."""
    RECOVERED = "recovered"
    """No longer bad, or not bad from the first frame on."""
    BAD = "bad"
    GAP = "gap"
    """Not bad, but the frame before was stale when this one came."""


_BAD: Final = Quality.BAD  # members of an enum are slow to look up, and these are for each frame
_NONE: Final = QualityChange.NONE


class FrameFollower(Cursor[Frame]):
    """Reads a block's frames from the newest one on, and assesses the last one. For one thread.

    What to do with a frame is the caller's: read it with :meth:`poll`, :meth:`read` or
    :meth:`newest`, then :meth:`take` it. Without a new one, ask whether it :meth:`became_stale`.
    """

    def __init__(self, block: Block, *, catch_up_s: float | None = None, notice_gaps: bool = False) -> None:
        """Start to follow a block.

        Args:
            block: The block.
            catch_up_s: When :meth:`read` is further behind than this time, or than half the ring,
                it skips to the newest frame, and counts the others as missed. None: it does not.
            notice_gaps: Whether :meth:`take` reports :attr:`QualityChange.GAP`.
        """
        super().__init__(block.ring, decode_frame, max(0, block.ring.head() - 1), lambda: block.retired)
        self.block = block
        self.frame: Frame | None = None
        """The last frame taken; None before the first."""
        self.quality = Quality.BAD
        """Quality when the last frame was taken or its age checked."""
        self.reason = "no data yet"
        """Why the quality is not good; empty if it is."""
        self._notice_gaps = notice_gaps
        self._most_behind = None
        if catch_up_s is not None:
            self._most_behind = max(1, min(round(catch_up_s * 1e9 / block.period_ns), block.ring.slot_count // 2))

    @property
    def stale(self) -> bool:
        """Whether the last frame is bad only because of its age."""
        return self.quality is _BAD and self.frame is not None and self.frame.quality is not _BAD

    def read(self, limit: int) -> Iterator[Frame]:
        """Yield new frames, at most ``limit``; when too far behind, skip to the newest first."""
        if self._most_behind is not None and self.behind > self._most_behind:
            newest = self._ring.head()
            self.missed += newest - 1 - self._last
            self._last = newest - 1
        for _ in range(limit):
            if (frame := self.poll()) is None:
                return
            yield frame

    def newest(self) -> Frame | None:
        """Return the newest frame, and continue behind it; None: there is none yet.

        Raises:
            SegmentError: The writer overtook the reader at every attempt to copy.
        """
        frame = self.block.latest()
        if frame is not None:
            self._last = frame.number
        return frame

    def take(self, frame: Frame, *, aged: bool = True) -> QualityChange:
        """Make a frame the last one, and return how it changes the quality.

        Args:
            frame: The frame.
            aged: Whether its quality is that of now, which depends on its age; otherwise it is the
                one that the frame was published with.
        """
        last, before = self.frame, self.quality
        self.frame = frame
        quality, reason = self.block.assess(frame) if aged else (frame.quality, frame.reason)
        change = _NONE
        if quality is not before or reason != self.reason:
            self.quality, self.reason = quality, reason
            change = QualityChange.DETAIL
        if quality is _BAD:
            return change if before is _BAD else QualityChange.BAD
        if before is _BAD:
            return QualityChange.RECOVERED
        if (
            self._notice_gaps
            and last is not None
            and frame.number == last.number + 1  # else the frames between may have come in time
            and last.age_ns(frame.publish_ns) > self.block.stale_ns
        ):
            return QualityChange.GAP
        return change

    def became_stale(self) -> bool:
        """Return whether the last frame has become stale since it was taken, once."""
        if self.frame is None or self.quality is _BAD:
            return False
        quality, reason = self.block.assess(self.frame)
        if quality is not _BAD:
            return False
        self.quality, self.reason = quality, reason
        return True

    def restart(self) -> None:
        """Forget the last frame, and begin with the newest one again."""
        self._last = max(0, self._ring.head() - 1)
        self.frame, self.quality, self.reason = None, Quality.BAD, "no data yet"
