"""Connected inputs: registers of other sources, read before a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from shmio.errors import PathError, SegmentError
from shmio.layout.topic import Topic, find
from shmio.layout.values.codec import RegisterCodec, Value, codec
from shmio.local.reading import holds_none
from shmio.segment import Block, Frame, Quality, Segment

NO_DATA: Final = "no data yet"


class Inputs:
    """The connections of one source; for one thread.

    From a block that takes part in steps it reads the frame before the present step, whichever
    source is faster (the Jacobi method). From any other block it reads the newest frame.
    """

    def __init__(self, segment: Segment, connections: Mapping[str, Topic]) -> None:
        """Create the inputs.

        Args:
            segment: A segment for this object alone, because it follows reloads.
            connections: The topic of each input, by the input's path.

        """
        self._segment = segment
        self._connections = connections
        self._found: dict[str, tuple[Block, RegisterCodec]] = {}

    def read(self, step: int | None) -> tuple[dict[str, Value], str]:
        """Return the good values by input, and why others are missing.

        ``step`` is None in wall time.
        """
        if self._segment.refresh():
            self._found = {}
        values: dict[str, Value] = {}
        missing: list[str] = []
        frames: dict[str, tuple[Frame | None, str]] = {}
        for path, topic in self._connections.items():
            try:
                block, decoder = self._find(path, topic)
                if block.source not in frames:
                    frames[block.source] = _frame(block, step)
            except (PathError, SegmentError) as error:
                missing.append(f"input {path}: {error}")
                continue
            frame, reason = frames[block.source]
            value = None if frame is None else decoder.decode(frame.image)
            if holds_none(value):
                missing.append(
                    f"input {path} keeps its value: {block.source}: {reason or 'the bytes are not a valid value'}"
                )
            else:
                values[path] = value
        return values, "; ".join(missing)

    def _find(self, path: str, topic: Topic) -> tuple[Block, RegisterCodec]:
        if path not in self._found:
            block = self._segment.blocks.get(topic.source)
            if block is None:
                raise PathError(f"there is no source {topic.source!r} any more")
            self._found[path] = block, codec(find(block.layout, topic.path), block.layout.byte_order)
        return self._found[path]


def _frame(block: Block, step: int | None) -> tuple[Frame | None, str]:
    """Return the frame to read, or None and why it cannot be trusted."""
    frame = block.latest()
    while frame is not None and step is not None and block.came_with(frame, step):
        frame = block.read(frame.number - 1)
    if frame is None:
        return None, NO_DATA
    quality, reason = block.assess(frame)
    if quality is Quality.BAD:
        return None, reason if frame.quality is Quality.BAD else "stale"
    return frame, ""
