"""What a local program gets to see: a register's reading, a frame with its layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import find, parse_topic
from shmio.layout.values.codec import Value, codec
from shmio.segment.block import Block
from shmio.segment.frame import Frame, Provenance, Quality

if TYPE_CHECKING:
    import numpy as np

    from shmio.layout.values.frame_codec import FrameCodec


@dataclass(frozen=True, slots=True)
class Reading:
    """One register as of now. ``value`` is the last one known even while quality is bad; None if there never was one.

    ``source_time`` is UTC in s, ``age_s`` the time since the frame was published, by its source's clock.
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

    block: Block
    """The one that the frame is of."""
    frame: Frame
    missed: int = 0

    @property
    def source(self) -> str:
        """Name of the source."""
        return self.block.source

    @property
    def section(self) -> int:
        """Which of the blocks that its source has had; a reload may give it another, whose frames count from 1."""
        return self.block.section

    @property
    def layout(self) -> Layout:
        """Of the frame's image."""
        return self.block.layout

    @property
    def cycle(self) -> int:
        """Cycle of the source's schedule."""
        return self.frame.cycle

    @property
    def quality(self) -> Quality:
        """Quality as of now: it turns bad with age."""
        return self.block.assess(self.frame)[0]

    @property
    def reason(self) -> str:
        """Why quality is not good; empty if it is."""
        return self.block.assess(self.frame)[1]

    def __getitem__(self, path: str) -> Value:
        """The value of a register, or of an array's element, whatever the quality; PathError."""
        topic = parse_topic(path, (self.source,), self.source)
        if topic.direction == "in":
            raise PathError(f"{path}: a frame holds what comes out of its source; leave out /in")
        return self._decode(topic.path, self.frame.image)

    def original(self, path: str) -> Value:
        """What the source delivered, whatever injections show instead; PathError."""
        return self._decode(parse_topic(path, (self.source,), self.source).path, self.frame.raw)

    def _decode(self, path: str, image: bytes) -> Value:
        return codec(find(self.layout, path), self.layout.byte_order).decode(image)

    @cached_property
    def array(self) -> np.ndarray[Any, np.dtype[Any]]:
        """The whole frame decoded: a numpy structured array of shape (1,), one field for each register's path."""
        return _frame_codec(self.layout).decode(self.frame.image)


@lru_cache(maxsize=64)
def _frame_codec(layout: Layout) -> FrameCodec:
    from shmio.layout.values.frame_codec import FrameCodec  # noqa: PLC0415  numpy only for those who ask for arrays

    return FrameCodec(layout)


def reading(block: Block, register: Register, frame: Frame | None) -> Reading:
    """One register of one frame, with what is known about it now."""
    if frame is None:
        return Reading(None, Quality.BAD, "no data yet", str(Provenance.LIVE), None, None)
    now_ns = block.now_ns()
    quality, reason = frame.assess(block.stale_ns, now_ns)
    known = frame.source_ns != 0
    value = codec(register, block.layout.byte_order).decode(frame.image) if known else None
    if quality is not Quality.BAD and holds_none(value):
        quality, reason = Quality.BAD, f"the bytes are no {register.type}"
    source_time = frame.source_ns / 1e9 if known else None
    provenance = Provenance.INJECTED if injected(block, (register,), frame) else frame.provenance
    return Reading(value, quality, reason, str(provenance), source_time, round(frame.age_ns(now_ns) / 1e9, 6))


def injected(block: Block, registers: Sequence[Register], frame: Frame) -> bool:
    """Whether anything in these registers is injected: some of a frame may be."""
    if frame.effective is None:
        return False
    standing = [one for one in block.standing.read() if one.direction == "out"]
    return any(one.covers(register) for register in registers for one in standing)


def holds_none(value: Value) -> bool:
    """Whether a value, or an element of it, could not be decoded."""
    return any(map(holds_none, value)) if isinstance(value, list) else value is None
