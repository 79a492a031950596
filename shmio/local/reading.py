"""What a local program reads: values of single registers, and frames with their layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import find, parse_topic
from shmio.layout.values.codec import Value, codec
from shmio.model.statuses import RegisterStatus, worse
from shmio.model.values import Provenance, Quality, Reading
from shmio.segment.block import Block, Frame

if TYPE_CHECKING:
    import numpy as np

    from shmio.layout.values.frame_codec import FrameCodec


@dataclass(frozen=True)
class View:
    """A copy of a frame, which never changes, with the layout that decodes it.

    ``missed`` is the number of frames lost between the previous frame of a stream and this frame.
    """

    block: Block
    """Block in which the frame was published."""
    frame: Frame
    missed: int = 0

    @property
    def source(self) -> str:
        """Name of the source."""
        return self.block.source

    @property
    def section(self) -> int:
        """Index that identifies the frame's block within this run of the instance.

        If a reload replaces a source's block, the new block has another index, and its frame
        numbers start again at 1.
        """
        return self.block.section

    @property
    def layout(self) -> Layout:
        """Layout of the frame's image."""
        return self.block.layout

    @property
    def cycle(self) -> int:
        """Cycle of the source's schedule; in virtual time, the number of the step."""
        return self.frame.cycle

    @property
    def quality(self) -> Quality:
        """The frame's quality now: a frame becomes bad when it is too old."""
        return self.block.assess(self.frame)[0]

    @property
    def reason(self) -> str:
        """Reason why the quality is not good; empty if it is good."""
        return self.block.assess(self.frame)[1]

    def __getitem__(self, path: str) -> Value:
        """Return a register's or element's value as consumers see it, whatever its quality.

        Raises:
            PathError: There is no such register.
        """
        topic = parse_topic(path, (self.source,), self.source)
        if topic.direction == "in":
            raise PathError(f"{path}: a frame has only the outputs of its source; leave out /in")
        return self._decode(topic.path, self.frame.image)

    def original(self, path: str) -> Value:
        """Return the value that the source delivered for a register, without injections.

        Args:
            path: Path of a register or element.

        Raises:
            PathError: There is no such register.
        """
        return self._decode(parse_topic(path, (self.source,), self.source).path, self.frame.raw)

    def status(self, path: str) -> RegisterStatus | None:
        """Return the status that the source gave a register; None if the source gives no status.

        Args:
            path: Path of a register or element.

        Raises:
            PathError: There is no such register.
        """
        register = find(self.layout, parse_topic(path, (self.source,), self.source).path)
        return status_of(self.block, register, self.frame)

    def _decode(self, path: str, image: bytes) -> Value:
        return codec(find(self.layout, path), self.layout.byte_order).decode(image)

    @cached_property
    def array(self) -> np.ndarray[Any, np.dtype[Any]]:
        """The decoded frame: a numpy structured array of shape (1,), with a field for each register.

        The name of a field is the path of its register.
        """
        return _frame_codec(self.layout).decode(self.frame.image)


@lru_cache(maxsize=64)
def _frame_codec(layout: Layout) -> FrameCodec:
    from shmio.layout.values.frame_codec import FrameCodec  # noqa: PLC0415  numpy only for those who ask for arrays

    return FrameCodec(layout)


def reading(block: Block, register: Register, frame: Frame | None, *, aged: bool = True) -> Reading:
    """Return the reading of one register in a frame.

    Args:
        block: The frame's block.
        register: The register.
        frame: The frame; None if the source has not published one yet.
        aged: True: assess the frame's quality now, by its age. False: use the quality that it had
            at publication.
    """
    if frame is None:
        return Reading(block.source, register, None, Quality.BAD, "no data yet", str(Provenance.LIVE), None, None)
    now_ns = block.now_ns()
    quality, reason = block.assess(frame, now_ns) if aged else (frame.quality, frame.reason)
    source_ns = frame.source_ns
    is_injected = injected(block, (register,), frame)
    value = codec(register, block.byte_order).decode(frame.image) if source_ns else None
    if source_ns and (status := status_of(block, register, frame)) is not None:
        quality, reason = worse(quality, reason, status)
        source_ns = status.source_ns or source_ns
        if status.waits and not is_injected:
            value, source_ns = None, 0
    if quality is not Quality.BAD and holds_none(value):
        quality, reason = Quality.BAD, f"the bytes are not a valid {register.type}"
    source_time = source_ns / 1e9 if source_ns else None
    provenance = Provenance.INJECTED if is_injected else frame.provenance
    age_s = round(frame.age_ns(now_ns) / 1e9, 6)
    return Reading(block.source, register, value, quality, reason, str(provenance), source_time, age_s)


def status_of(block: Block, register: Register, frame: Frame) -> RegisterStatus | None:
    """Return the status that the source gave a register in a frame; None if it gives no status."""
    area = block.statuses
    return None if area is None else area.get(frame.raw, area.index(register))


def injected(block: Block, registers: Sequence[Register], frame: Frame) -> bool:
    """Return whether an injection covers any of these registers in a frame."""
    if frame.effective is None:
        return False
    present = [one for one in block.injections.read() if one.direction == "out"]
    return any(one.covers(register) for register in registers for one in present)


def holds_none(value: Value) -> bool:
    """Return whether a value, or an element of it, is None.

    None stands for bytes that could not be decoded.
    """
    return any(map(holds_none, value)) if isinstance(value, list) else value is None
