"""Helpers for tests of injections in a source's process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from shmio.config import Declaration
from shmio.connectors.injection_layers import Owner
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value
from shmio.local.reading import reading
from shmio.local.writer import SourceWriter
from shmio.model.values import Reading
from shmio.segment import Attributes, BlockSpec, Frame, ProcessSpec, Segment
from shmio.segment.injection_list import declared_document

PERIOD_NS = 10_000_000


def tag_layout(registers: str) -> Layout:
    """Return the layout of a tag table with these lines of registers."""
    return compile_sources([Source("cell.toml", f"[registers]{registers}".encode())]).layouts[0]


def block(
    layout: Layout, writable: Sequence[str], source: str = "cell", declared: Sequence[Declaration] = ()
) -> BlockSpec:
    attributes = Attributes("device", tuple(writable), armed=True)
    return BlockSpec(source, layout, PERIOD_NS, 10**9, 1 << 20, attributes, declared_document(declared))


@contextmanager
def source_segment(instance: str, *blocks: BlockSpec) -> Iterator[Segment]:
    """Create a segment with these blocks and the process of source cell."""
    with Segment.create(instance, blocks, [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()


class SourceRig:
    """The block of the source ``cell``, its events, and two clients that write to the block."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self.block = segment.blocks["cell"]
        self.owners = {4: Owner(4, 100), 5: Owner(5, 200)}
        self.client, self.other = SourceWriter(self.block, 4), SourceWriter(self.block, 5)
        self.events = self.block.events.cursor()

    def reading(self, path: str, frame: Frame | None = None) -> Reading:
        """Return what consumers see of a register, by default in the latest frame."""
        layout = self.block.layout
        return reading(self.block, layout.registers[layout.by_path[path]], frame or self.block.latest())

    def value(self, path: str, frame: Frame | None = None) -> Value:
        return self.reading(path, frame).value
