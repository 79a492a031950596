"""What a path names: a register, an array's element, or all below a structure."""

from __future__ import annotations

from typing import NamedTuple

from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, look_up


class Shape(NamedTuple):
    """What a path names. ``path``: canonical, in the block."""

    path: str
    registers: tuple[Register, ...]
    whole: bool
    """Whether it is a register, or an array's element, as a whole; else a structure."""

    @property
    def elements(self) -> int:
        """Numbers, bits and texts in it."""
        return sum(register.count for register in self.registers)


def shape(layout: Layout, topic: Topic) -> Shape:
    """What a topic names in a layout; PathError."""
    below = layout.members(topic.path)
    if below:
        return Shape(topic.path, tuple(layout.registers[index] for index in below), whole=False)
    return Shape(topic.path, (look_up(layout, topic),), whole=True)
