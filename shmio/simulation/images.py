"""The two images of a block whose registers a model computes: the commanded and the shown one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from shmio.errors import LayoutError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout, Register
from shmio.layout.values.write import Write, apply, covering


class Images:
    """Both images of one block, first with its initial values.

    ``commanded`` has what others have written to inputs, to the ``/in`` of in-outs, and to
    registers unknown to the model. ``shown`` is what consumers see. The model computes outputs and
    the ``/out`` of in-outs.
    """

    def __init__(self, layout: Layout, outputs: Sequence[Register], inouts: Sequence[Register] = ()) -> None:
        """Create the images.

        Args:
            layout: The layout of the block.
            outputs: Registers that nobody but the model writes.
            inouts: Registers that others command and the model computes.

        """
        initial, _ = initial_frame(layout)
        self.commanded, self.shown = bytearray(initial), initial
        self._outputs = tuple(outputs)
        self._computed = covering(outputs, layout.size)
        self._given = ~_array(covering((*outputs, *inouts), layout.size))
        self._all_computed = not self._given.any()

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Command bytes and bits.

        Return for each "" or why it is refused, which is that the model computes it.
        """
        return [self._write(write) for write in writes]

    def resume(self, image: bytes) -> None:
        """Continue from an image, as commanded and as shown; LayoutError if its size is wrong."""
        if len(image) != len(self.shown):
            raise LayoutError(f"its block has {len(self.shown)} bytes, the image {len(image)}")
        self.shown[:] = self.commanded[:] = image

    def with_given(self, image: bytes | bytearray) -> bytes:
        """Return an image with the commanded values of all that the model does not compute."""
        if self._all_computed:
            return bytes(image)
        return (_array(self.commanded) & self._given | _array(image) & ~self._given).tobytes()

    def _write(self, write: Write) -> str:
        offset, mask, data = write
        stop = offset + len(data)
        if stop > len(self.commanded):
            return f"it is outside the block of {len(self.commanded)} bytes"
        if self._computed[offset] & mask if mask else any(self._computed[offset:stop]):
            hit = [r.path for r in self._outputs if r.offset < stop and offset < r.offset + r.size]
            return f"the model computes {hit[0]}: it is an output and cannot be written; shmio inject can show others"
        apply(write, self.commanded)
        return ""


def _array(data: bytes | bytearray) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)
