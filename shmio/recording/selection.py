"""Selects the sources and registers to record."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.overlay import needed
from shmio.layout.topic import near, parse_topic
from shmio.layout.values.write import chosen, covering
from shmio.model.statuses import StatusArea
from shmio.segment import Block, Frame
from shmio.wording import did_you_mean, unknown


class RecordedRegisters:
    """The registers of a block to record. ``layout`` has only these registers, at their original offsets.

    If the block has a status area, the recorded status area is shorter: it has the statuses of only
    these registers.
    """

    def __init__(self, layout: Layout, registers: Sequence[Register] | None = None) -> None:
        """Select registers of a layout; None selects all."""
        self.layout = layout
        self._mask: npt.NDArray[np.uint8] | None = None
        self._taken: npt.NDArray[np.intp] | slice = slice(None)  # from where each byte comes
        if registers is None:
            return
        mask = np.frombuffer(covering(registers, layout.size), np.uint8)
        if layout.status_offset is None:
            self.layout, self._mask = replace(layout, registers=tuple(registers)), mask
            return
        values = replace(layout, registers=tuple(registers), size=layout.status_offset, status_offset=None)
        self.layout = values.with_statuses()
        self._mask, self._taken = _with_statuses(layout, self.layout, mask[: layout.status_offset])

    @property
    def whole(self) -> bool:
        """True if all registers are selected, so that frames stay as they are."""
        return self._mask is None

    def keep(self, frame: Frame) -> Frame:
        """Return the frame with images that have only these registers; all other bits are zero."""
        if self._mask is None:
            return frame
        effective = None if frame.effective is None else self._kept(frame.effective, self._mask)
        return frame._replace(raw=self._kept(frame.raw, self._mask), effective=effective)

    def _kept(self, image: bytes, mask: npt.NDArray[np.uint8]) -> bytes:
        return (np.frombuffer(image, np.uint8)[self._taken] & mask).tobytes()


def _with_statuses(
    whole: Layout, part: Layout, mask: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.intp]]:
    """Return the mask of a reduced image with statuses, and the offset to copy each byte from.

    The offsets are those in the whole image. ``mask`` is the mask of the values, without statuses.
    """
    old, new = StatusArea(whole), StatusArea(part)
    kept, taken = np.zeros(part.size, np.uint8), np.zeros(part.size, np.intp)
    kept[: len(mask)], taken[: len(mask)] = mask, np.arange(len(mask))
    for index, register in enumerate(part.own):
        for of in (StatusArea.code_range, StatusArea.time_range):
            (start, size), (to, _) = of(old, old.index(register)), of(new, index)
            kept[to : to + size], taken[to : to + size] = 0xFF, np.arange(start, start + size)
    return kept, taken


class Selection:
    """The sources and registers to record.

    ``sources`` are the names of the sources; None for all. ``registers`` are patterns as for
    ``shmio get``; empty for all. A pattern that names an element selects its whole array. A pattern
    that names a register of a tag table over the block also selects the block's own register with
    the same bytes.
    """

    def __init__(self, sources: Collection[str] | None = None, registers: Sequence[str] = ()) -> None:
        self._sources = sources
        self._registers = registers

    def part(self, block: Block, sources: Collection[str]) -> RecordedRegisters | None:
        """Return the registers of a block to record; None if there are none.

        ``sources`` are the names of all sources of the instance.
        """
        if self._sources is not None and block.source not in self._sources:
            return None
        if not self._registers:
            return RecordedRegisters(block.layout)
        paths = {path for pattern in self._registers for path in _paths(pattern, block.source, block.layout, sources)}
        registers = tuple(register for register in block.layout.registers if register.path in paths)
        if len(registers) == len(block.layout.registers):
            return RecordedRegisters(block.layout)
        return RecordedRegisters(block.layout, registers) if registers else None

    def unmatched(self, layouts: Mapping[str, Layout]) -> list[str]:
        """Return a message for each selected source or pattern that does not exist.

        ``layouts`` are the layouts of all sources, by name.
        """
        missing = [unknown("source", source, layouts) for source in self._sources or () if source not in layouts]
        missing += [
            f"{pattern}: no register has this path{_near(pattern, layouts)}"
            for pattern in self._registers
            if not any(_paths(pattern, source, layout, layouts) for source, layout in layouts.items())
        ]
        return missing


def _near(pattern: str, layouts: Mapping[str, Layout]) -> str:
    """Return the end of a message, which suggests similar paths; empty if there are none."""
    try:
        topic = parse_topic(pattern, layouts, next(iter(layouts)) if len(layouts) == 1 else None)
    except PathError:
        return ""
    alike = [] if "*" in pattern or topic.source not in layouts else near(layouts[topic.source], topic.path)
    return f"; {did_you_mean([f'{topic.source}/{path}' for path in alike])}" if alike else ""


def _paths(pattern: str, source: str, layout: Layout, sources: Collection[str]) -> set[str]:
    """Return the paths of a source's registers that a pattern names.

    The result is empty if the pattern is for another source.
    """
    try:
        topic = parse_topic(pattern, sources, next(iter(sources)) if len(sources) == 1 else None)
        if topic.source != source or topic.direction == "in":
            return set()
        return set().union(*(needed(layout, register) for register in chosen(layout, topic.path or "**")))
    except PathError:
        return set()
