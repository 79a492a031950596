"""Chosen registers of a recording: as if the others had never been there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from shmio.dump.blocks import DumpBlock
from shmio.dump.changes import register_bytes
from shmio.dump.dump import Dump, Entry
from shmio.dump.reader import Item
from shmio.layout.model import Register
from shmio.segment import Frame

_Bytes = npt.NDArray[np.uint8]


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
        block, mask = self._parts[entry.block]
        item = entry.item
        if isinstance(item, Frame):
            effective = None if item.effective is None else _kept(item.effective, mask)
            item = item._replace(raw=_kept(item.raw, mask), effective=effective)
        return Entry(entry.time_ns, block, item)


def _part(block: DumpBlock, registers: Sequence[Register]) -> tuple[DumpBlock, _Bytes]:
    """The block with these registers alone, and a mask over its image."""
    paths = {register.path for register in registers}
    whole = [
        register
        for register in block.layout.registers
        if register.path in paths or any(path.startswith(f"{register.path}/") for path in paths)
    ]
    layout = replace(block.layout, registers=tuple(whole))
    mask = np.zeros(layout.size, np.uint8)
    places, masks = register_bytes(whole)
    np.bitwise_or.at(mask, places, masks)
    return replace(block, layout=layout, layout_hash=layout.hash.hex()), mask


def _kept(image: bytes, mask: _Bytes) -> bytes:
    return (np.frombuffer(image, np.uint8) & mask).tobytes()
