"""Chosen registers of a recording: as if the others had never been there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shmio.dump.blocks import DumpBlock
from shmio.dump.dump import Dump
from shmio.dump.entries import Entry
from shmio.dump.reader import Item
from shmio.layout.model import Register
from shmio.layout.topic import holder
from shmio.layout.write import covering
from shmio.recording.selection import Part
from shmio.segment import Frame


class Parts:
    """Blocks of a dump with some of their registers; all other bytes are zero."""

    def __init__(self, dump: Dump, paths: Sequence[str]) -> None:
        """PathError: no such register. An element stands for its array."""
        self._parts = {block: _part(block, registers) for block, registers in dump.select(paths).items()}

    @property
    def sources(self) -> list[str]:
        """Of these registers."""
        return list(dict.fromkeys(block.source for block in self._parts))

    def of(self, entry: Entry[Item]) -> Entry[Item] | None:
        """An entry as it would be; None: it is of a block that has none of the registers."""
        if entry.block is None:
            return entry
        if entry.block not in self._parts:
            return None
        block, part = self._parts[entry.block]
        item = entry.item
        return Entry(entry.time_ns, block, part.keep(item) if isinstance(item, Frame) else item)


def _part(block: DumpBlock, registers: Sequence[Register]) -> tuple[DumpBlock, Part]:
    """The block with these registers alone, and what makes its frames."""
    paths = {holder(block.layout, register) for register in registers}
    whole = tuple(register for register in block.layout.registers if register.path in paths)
    layout = replace(block.layout, registers=whole)
    part = Part(layout, np.frombuffer(covering(whole, layout.size), np.uint8))
    digest = layout.hash.hex()
    of = "" if digest == block.layout_hash else block.of or block.layout_hash
    return replace(block, layout=layout, layout_hash=digest, of=of), part
