"""The image of a block with the accepted commands that are not in a frame yet."""

from __future__ import annotations

from shmio.layout.values.write import Write
from shmio.segment import Block, Event
from shmio.segment.pending_commands import apply


class PendingImage:
    """A frame's image with the commands applied that were accepted after it.

    ``mask`` has the bits set that the present command writes.
    """

    def __init__(self, block: Block) -> None:
        self.image = bytearray(block.layout.size)
        self.mask = bytearray(block.layout.size)
        self._block = block
        self._frame = -1

    def begin(self, number: int) -> None:
        """Begin a command that was accepted after this frame.

        A frame that comes between the command's parts does not reset the image.
        """
        if number != self._frame:
            frame = self._block.read(number) or self._block.latest()
            self._frame = number
            self.image = bytearray(len(self.image)) if frame is None else bytearray(frame.image)
        self.mask = bytearray(len(self.mask))

    def put(self, event: Event) -> None:
        """Apply a part of the command."""
        apply(self.image, (Write(event.offset, event.mask, event.data),))
        apply(self.mask, (ones(event),))

    def forget(self) -> None:
        """Discard the image, because a part of a command is missing."""
        self._frame = -1


def ones(event: Event) -> Write:
    """Return a write that sets all bits that a part of a command writes."""
    return Write(event.offset, event.mask, b"\xff" * len(event.data))
