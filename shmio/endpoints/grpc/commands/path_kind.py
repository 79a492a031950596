"""Resolves a path to a register, an array's element, or all registers below a structure."""

from __future__ import annotations

from typing import NamedTuple

from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, look_up


class Shape(NamedTuple):
    """The registers that a path names.

    Attributes:
        path: Canonical path in the block.
        registers: One register or array element, or all registers below a structure.
        whole: Whether the path names a register or an element, not a structure.

    """

    path: str
    registers: tuple[Register, ...]
    whole: bool

    @property
    def elements(self) -> int:
        """Number of values in all registers: numbers, bits and texts."""
        return sum(register.count for register in self.registers)


def shape(layout: Layout, topic: Topic) -> Shape:
    """Return what a topic names in a layout. PathError: nothing."""
    below = layout.members(topic.path)
    if below:
        return Shape(topic.path, tuple(layout.registers[index] for index in below), whole=False)
    return Shape(topic.path, (look_up(layout, topic),), whole=True)
