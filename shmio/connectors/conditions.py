"""The values that conditions read: of the own source as its device has just delivered them, of others the newest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from shmio.connectors.output import Image
from shmio.errors import SegmentError
from shmio.injection import Program
from shmio.injection.expression import Number
from shmio.segment import Block, Quality


class Readings:
    """Images of sources as of one cycle; each is fetched once, and only if a condition asks for it.

    All are what the sources delivered, before any injection, so that none feeds back upon itself. Nothing is known of
    a source whose quality is bad.
    """

    def __init__(self, own: str, image: Image, blocks: Mapping[str, Block], before: int | None) -> None:
        """``own``: the source whose next image this is.

        ``before``: the step that this is, if it is one: of others that take part in it, the image of the step before is
        read, whoever is faster.
        """
        self._blocks = blocks
        self._before = before
        known = image.quality is not Quality.BAD and image.source_ns != 0
        self._images: dict[str, bytes | None] = {own: image.raw if known else None}

    def of(self, program: Program) -> Sequence[Number | None]:
        """The values that a program's condition reads; None: not known."""
        if program.condition is None:
            return ()
        values: list[Number | None] = []
        for source, codec in program.condition.reads:
            image = self._image(source)
            value = None if image is None else codec.decode(image)
            values.append(value if isinstance(value, bool | int | float) else None)
        return values

    def _image(self, source: str) -> bytes | None:
        if source not in self._images:
            block = self._blocks.get(source)
            self._images[source] = None if block is None else _newest(block, self._before)
        return self._images[source]


def _newest(block: Block, before: int | None) -> bytes | None:
    try:
        frame = block.latest()
        while frame is not None and before is not None and block.came_with(frame, before):
            frame = block.read(frame.number - 1)
    except SegmentError:
        return None
    if frame is None or block.retired or frame.source_ns == 0:
        return None
    return None if block.assess(frame)[0] is Quality.BAD else frame.raw
