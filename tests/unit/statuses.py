"""A segment with a source that gives each register a status."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from shmio.connectors.register_image import RegisterImage
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.values.codec import Value
from shmio.segment import Attributes, BlockSpec, BlockWriter, ProcessSpec, Segment

TABLE = b"""
[registers]
count = "INT"
speed = { type = "REAL", unit = "mm/s" }
row = "ARRAY[0..3] OF INT"
lamp = "BOOL"
"""
LAYOUT = compile_sources([Source("plant.toml", TABLE)]).layouts[0].with_statuses()
COUNT, SPEED, ROW, LAMP = range(4)
STALE_NS = 60_000_000_000
SOURCE_NS = 1_700_000_000_000_000_000


def first_image() -> RegisterImage:
    """Return an image in which all registers are good, each with a source time of its own."""
    image = RegisterImage(LAYOUT)
    values: tuple[Value, ...] = (1, 1.5, [1, 2, 3, 4], True)
    for index, value in enumerate(values):
        image.put(index, value, SOURCE_NS + index)
    return image


@contextmanager
def plant(instance: str) -> Iterator[tuple[Segment, BlockWriter]]:
    """Create a segment with the source ``plant``, which has published nothing yet."""
    block = BlockSpec("plant", LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", ("count",)))
    processes = [ProcessSpec("plant", "source"), ProcessSpec("grpc", "grpc")]
    with Segment.create(instance, [block], processes) as segment:
        yield segment, segment.writer("plant")
        segment.unlink()
