"""Placed declarations: structures with the offset of each member, before expansion."""

from __future__ import annotations

import math
from dataclasses import dataclass

from shmio.layout.model import Dims
from shmio.layout.source.syntax import Member
from shmio.layout.types import ElementType


@dataclass(frozen=True, slots=True)
class Leaf:
    """A register: an elementary type or an array of one; ``size`` in bytes, without padding."""

    element: ElementType
    dims: Dims
    size: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of elements in each dimension."""
        return tuple(high - low + 1 for low, high in self.dims)


@dataclass(frozen=True, slots=True)
class Cost:
    """Size of an expansion: registers, their elements, characters of their texts, structures."""

    registers: int = 0
    elements: int = 0
    text: int = 0
    structures: int = 0

    def plus(self, inner: Cost, times: int, text_each: int) -> Cost:
        """Return this cost plus ``times`` the inner one.

        ``text_each`` is the number of characters by which each inner register's path gets longer.
        """
        return Cost(
            self.registers + times * inner.registers,
            self.elements + times * inner.elements,
            self.text + times * (inner.text + inner.registers * text_each),
            self.structures + times * inner.structures,
        )


@dataclass(frozen=True, slots=True)
class Group:
    """A placed structure; ``size`` in bytes, always even. ``opaque``: its members are unknown."""

    fields: dict[str, Field]  # by name in lower case: S7 names are case-insensitive
    size: int
    cost: Cost
    height: int
    opaque: bool = False


@dataclass(frozen=True, slots=True)
class Repeat:
    """An array of structures."""

    group: Group
    dims: Dims


@dataclass(frozen=True, slots=True)
class Field:
    """A member with its place in its structure: ``offset`` in bytes, ``bit`` for a single BOOL."""

    segment: str
    member: Member
    type: Leaf | Group | Repeat
    offset: int
    bit: int | None


@dataclass(frozen=True, slots=True)
class Extent:
    """Space that a member takes.

    ``size`` (with padding) and ``align`` are in bytes, ``cost`` is the size of its expansion, and
    ``height`` the number of structure levels below it.
    """

    size: int
    align: int
    cost: Cost
    height: int


def extent_of(placed: Leaf | Group | Repeat) -> Extent:
    """Return the space that a placed type takes as a member."""
    if isinstance(placed, Leaf):
        cost = Cost(1, math.prod(placed.shape))
        if placed.dims:
            return Extent(round_up(placed.size, 2), 2, cost, 0)
        return Extent(placed.size, placed.element.align, cost, 0)
    if isinstance(placed, Group):
        return Extent(placed.size, 2, Cost(structures=1).plus(placed.cost, 1, 0), placed.height)
    group, count = placed.group, math.prod(high - low + 1 for low, high in placed.dims)
    index_text = sum(1 + max(len(str(low)), len(str(high))) for low, high in placed.dims)
    cost = Cost(elements=count, structures=count).plus(group.cost, count, index_text)
    return Extent(count * group.size, 2, cost, group.height)


def round_up(value: int, step: int) -> int:
    """Return the value rounded up to a multiple of ``step``."""
    return -(-value // step) * step
