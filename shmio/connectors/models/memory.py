"""A source without a device; each register keeps the value last written to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from shmio.connectors.base import Computed
from shmio.errors import SnapshotError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.values.write import Write, apply


class Memory(Computed):
    """``connector = "memory"``: a value written to ``/in`` appears on ``/out`` at once.

    The registers begin with the initial values of the layout. A restarted process continues with
    the last values. Use this source for programs that publish signals, such as a remote simulator,
    an operator panel or a test.
    """

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Keys of the source; this connector has none."""

    prompt = True

    def __init__(self, options: Options, layout: Layout) -> None:  # noqa: ARG002  there are no keys
        self._image, _ = initial_frame(layout)

    def resume(self, image: bytes) -> None:
        """Continue with the values of the source's previous process."""
        self._image[:] = image

    def begin(self) -> bytes:
        """Return the image of all registers."""
        return bytes(self._image)

    def save(self) -> bytes:
        """Return the image, which is the whole state."""
        return bytes(self._image)

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check an image from :meth:`save`, and return the function that restores it."""
        if len(data) != len(self._image):
            raise SnapshotError("its image has another size")
        return lambda: self.resume(data)

    def write(self, writes: Sequence[Write]) -> list[str]:
        """Store the values; every write succeeds."""
        for write in writes:
            apply(write, self._image)
        return [""] * len(writes)

    def step(self, time_ns: int, dt_ns: int) -> bytes:  # noqa: ARG002  time changes nothing
        """Return the image of all registers, which time does not change."""
        return bytes(self._image)
