"""A block as it will be when what its source has accepted is done."""

from __future__ import annotations

from shmio.layout.values.write import Write
from shmio.segment import Block, Event
from shmio.segment.pending_commands import apply


class PendingImage:
    """``image``: a frame, and what was accepted behind it. ``mask``: the bits that the present command has written."""

    def __init__(self, block: Block) -> None:
        self.image = bytearray(block.layout.size)
        self.mask = bytearray(block.layout.size)
        self._block = block
        self._frame = -1

    def begin(self, number: int) -> None:
        """A command begins, behind this frame; frames that come between its parts must not undo the first ones."""
        if number != self._frame:
            frame = self._block.read(number) or self._block.latest()
            self._frame = number
            self.image = bytearray(len(self.image)) if frame is None else bytearray(frame.image)
        self.mask = bytearray(len(self.mask))

    def put(self, event: Event) -> None:
        """A part of it."""
        apply(self.image, (Write(event.offset, event.mask, event.data),))
        apply(self.mask, (ones(event),))

    def forget(self) -> None:
        """Something was not put: the image is worth nothing."""
        self._frame = -1


def ones(event: Event) -> Write:
    """The bits that a part of a command writes, all set."""
    return Write(event.offset, event.mask, b"\xff" * len(event.data))
