"""The way in for a local program: attach to an instance, read values by path, follow frames.

Five lines::

    import shmio
    with shmio.attach("a50") as cell:
        print(cell["cell/Robot_800/Axs1_Pos"])
        for view in cell.stream("cell"):
            print(view.cycle, view["Robot_800/Axs1_Pos"], view.missed)

It maps the segment read-only and needs nothing from the instance: no lock, no registration, no server.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from shmio.errors import NotRunningError, PathError, QualityError, SegmentError
from shmio.layout.codec import Value, codec
from shmio.layout.model import Layout, Register
from shmio.layout.topic import find, parse_topic
from shmio.segment.block import Block, Cursor
from shmio.segment.frame import Frame, Provenance, Quality
from shmio.segment.segment import Segment, running_instances

if TYPE_CHECKING:
    import numpy as np

    from shmio.layout.framecodec import FrameCodec


TURN_S = 1.0
"""How often a waiting reader looks whether the instance still is."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One register as of now. ``value`` is the last one known even while quality is bad; None if there never was one.

    ``source_time`` is UTC in s, ``age_s`` the time since the frame was published.
    """

    value: Value
    quality: Quality
    reason: str
    provenance: str
    source_time: float | None
    age_s: float | None


@dataclass(frozen=True)
class View:
    """A frame with its layout: a validated copy, which nothing changes any more.

    ``missed`` counts the frames lost between the one before in its stream and this one.
    """

    source: str
    frame: Frame
    layout: Layout
    stale_ns: int
    missed: int = 0

    @property
    def cycle(self) -> int:
        """Cycle of the source's schedule."""
        return self.frame.cycle

    @property
    def quality(self) -> Quality:
        """Quality as of now: it turns bad with age."""
        return self.frame.assess(self.stale_ns)[0]

    @property
    def reason(self) -> str:
        """Why quality is not good; empty if it is."""
        return self.frame.assess(self.stale_ns)[1]

    def __getitem__(self, path: str) -> Value:
        """The value of a register, or of an array's element, whatever the quality; PathError."""
        topic = parse_topic(path, (self.source,), self.source)
        if topic.direction == "in":
            raise PathError(f"{path}: a frame holds what comes out of its source; leave out /in")
        register = find(self.layout, topic.path)
        return codec(register, self.layout.byte_order).decode(self.frame.image)

    @cached_property
    def array(self) -> np.ndarray[Any, np.dtype[Any]]:
        """The whole frame decoded: a numpy structured array of shape (1,), one field for each register's path."""
        return _frame_codec(self.layout).decode(self.frame.image)


@lru_cache(maxsize=64)
def _frame_codec(layout: Layout) -> FrameCodec:
    from shmio.layout.framecodec import FrameCodec  # noqa: PLC0415  numpy only for those who ask for arrays

    return FrameCodec(layout)


class Attachment:
    """A running instance as a local program sees it. Use as a context manager, or :meth:`close`."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment

    def _blocks(self) -> dict[str, Block]:
        if self._segment.closed:
            raise SegmentError(f"detached from instance {self.instance!r}")
        return self._segment.blocks

    @property
    def instance(self) -> str:
        """Name of the instance."""
        return self._segment.instance

    @property
    def sources(self) -> list[str]:
        """Names of the sources."""
        return list(self._blocks())

    @property
    def current(self) -> bool:
        """Whether the instance still is the one attached to; after a stop, attach anew."""
        return self._segment.shared.current()

    def block(self, source: str | None = None) -> Block:
        """A source's block; None is allowed when there is only one source. PathError."""
        blocks = self._blocks()
        if source is None and len(blocks) == 1:
            return next(iter(blocks.values()))
        if source not in blocks:
            raise PathError(f"no source {source!r}; there are: {', '.join(blocks)}")
        return blocks[source]

    def resolve(self, path: str) -> tuple[Block, Register]:
        """Block and register of a topic's path; the source may be left out when there is only one. PathError."""
        blocks = self._blocks()
        topic = parse_topic(path, blocks, next(iter(blocks)) if len(blocks) == 1 else None)
        if topic.source not in blocks:
            raise PathError(f"{path}: nothing is served under {topic.source} in this version")
        if topic.direction == "in":
            raise PathError(f"{path}: what goes into a source cannot be read yet; leave out /in")
        block = blocks[topic.source]
        return block, find(block.layout, topic.path)

    def read(self, path: str) -> Reading:
        """A register with quality, reason and age; PathError."""
        block, register = self.resolve(path)
        return reading(block, register, block.latest())

    def __getitem__(self, path: str) -> Value:
        """A register's good value; PathError, and QualityError with the reason when there is none."""
        now = self.read(path)
        if now.quality is Quality.BAD:
            raise QualityError(f"{path}: {now.reason}")
        return now.value

    def frame(self, source: str | None = None) -> View:
        """A copy of a source's newest frame; QualityError before it has published its first."""
        block = self.block(source)
        frame = block.latest()
        if frame is None:
            raise QualityError(f"source {block.source}: no data yet")
        return View(block.source, frame, block.layout, block.stale_ns)

    def stream(self, source: str | None = None, timeout_s: float | None = None) -> Iterator[View]:
        """Every frame from this call on, once, in order, gaps counted; ends after ``timeout_s`` without one.

        NotRunningError when the instance has stopped.
        """
        block = self.block(source)
        return self._views(block, block.cursor(), timeout_s)

    def _views(self, block: Block, cursor: Cursor, timeout_s: float | None) -> Iterator[View]:
        missed = 0
        while (frame := self._next(cursor, timeout_s)) is not None:
            yield View(block.source, frame, block.layout, block.stale_ns, cursor.missed - missed)
            missed = cursor.missed

    def _next(self, cursor: Cursor, timeout_s: float | None) -> Frame | None:
        """Wait for a frame in turns: a stopped instance rings no bell."""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            rest_s = TURN_S if deadline_s is None else deadline_s - time.monotonic()
            frame = cursor.next(min(rest_s, TURN_S))
            if frame is not None:
                return frame
            if not self.current:
                raise NotRunningError(f"instance {self.instance!r} has stopped")
            if rest_s < TURN_S:
                return None

    def wait(
        self, source: str | None = None, *, after: View | None = None, timeout_s: float | None = None
    ) -> View | None:
        """The newest frame as soon as it is newer than ``after`` (default: than now); None when the time is over."""
        block = self.block(source)
        cursor = block.cursor(after=None if after is None else max(after.frame.number, block.ring.head() - 1))
        frame = self._next(cursor, timeout_s)
        return None if frame is None else View(block.source, frame, block.layout, block.stale_ns)

    def close(self) -> None:
        """Detach."""
        self._segment.close()

    def __enter__(self) -> Attachment:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def reading(block: Block, register: Register, frame: Frame | None) -> Reading:
    """One register of one frame, with what is known about it now."""
    if frame is None:
        return Reading(None, Quality.BAD, "no data yet", str(Provenance.LIVE), None, None)
    now_ns = time.monotonic_ns()
    quality, reason = frame.assess(block.stale_ns, now_ns)
    known = frame.source_ns != 0
    value = codec(register, block.layout.byte_order).decode(frame.image) if known else None
    if quality is not Quality.BAD and _holds_none(value):
        quality, reason = Quality.BAD, f"the bytes are no {register.type}"
    source_time = frame.source_ns / 1e9 if known else None
    return Reading(value, quality, reason, str(frame.provenance), source_time, round(frame.age_ns(now_ns) / 1e9, 6))


def _holds_none(value: Value) -> bool:
    """Whether a value, or an element of it, could not be decoded."""
    return any(map(_holds_none, value)) if isinstance(value, list) else value is None


def attach(instance: str | None = None) -> Attachment:
    """Attach to a running instance, by default the only one; NotRunningError, FormatError, SegmentError."""
    if instance is None:
        running = running_instances()
        if not running:
            raise NotRunningError("no instance is running; start one with shmio-supervisor up")
        if len(running) > 1:
            raise NotRunningError(f"several instances are running, name one of them: {', '.join(running)}")
        instance = running[0]
    return Attachment(Segment.open(instance))
