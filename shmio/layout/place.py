"""Placement: declarations to offsets, by Siemens' rules for blocks with standard access.

- BOOL takes the next bit; anything else begins at the next whole byte.
- One-byte types take the next byte; all wider types, strings included, begin at an even byte.
- Arrays and structures begin at an even byte and are padded to an even length.

A type is placed once, however often it is used; how much its expansion would need is known, and bounded, before
anything is expanded. ``docs/reference/layout-rules.md`` gives the rules with their evidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from shmio.layout.model import MAX_BLOCK_BYTES, MAX_DEPTH, MAX_ELEMENTS, MAX_REGISTERS, Dims, array_size
from shmio.layout.report import Report
from shmio.layout.syntax import Array, Member, Named, Position, Struct, Type, TypeDeclaration
from shmio.layout.topic import encode_segment
from shmio.layout.types import SYSTEM_TYPES, ElementType, element_type

MAX_NAME = 128  # characters, as in TIA Portal
MAX_TEXT = 32 << 20  # characters of all expanded paths, comments and initial values together


@dataclass(frozen=True, slots=True)
class Leaf:
    """A register: an elementary type or an array of one. ``size`` is unpadded, in bytes."""

    element: ElementType
    dims: Dims
    size: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of elements in each dimension."""
        return tuple(high - low + 1 for low, high in self.dims)


@dataclass(frozen=True, slots=True)
class Cost:
    """What an expansion needs: registers, their elements, and the characters of their texts."""

    registers: int = 0
    elements: int = 0
    text: int = 0

    def plus(self, inner: Cost, times: int, text_each: int) -> Cost:
        """Return the cost with ``times`` the inner one added, each register with so many characters more."""
        return Cost(
            self.registers + times * inner.registers,
            self.elements + times * inner.elements,
            self.text + times * (inner.text + inner.registers * text_each),
        )


@dataclass(frozen=True, slots=True)
class Group:
    """A placed structure. ``size`` is in bytes, even."""

    fields: dict[str, Field]  # by name in lower case: Siemens' names differ by more than case
    size: int
    cost: Cost
    height: int


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


class Placer:
    """Places structures; types of users are looked up by name and placed at first use."""

    def __init__(self, types: dict[str, TypeDeclaration], skipped: frozenset[str], report: Report) -> None:
        self._types = types
        self._skipped = skipped
        self._report = report
        self._placed: dict[str, Group | None] = {}
        self._open: list[str] = []

    def struct(self, struct: Struct, depth: int = 0) -> Group | None:
        """Place a structure; None if anything in it is wrong, which then has been reported.

        Only the body of a block may have no members: the parser has refused any other.
        """
        if depth and not struct.members:
            return None
        if depth >= MAX_DEPTH:
            self._refuse(struct.position, f"structures are nested more than {MAX_DEPTH} deep")
            return None
        fields: dict[str, Field] = {}
        bits = height = 0
        cost = Cost()
        good = True
        for member in struct.members:
            placed = self._member(member, fields, depth)
            if placed is None:
                good = False
                continue
            extent = _extent(placed)
            if isinstance(placed, Leaf) and placed.element.base == "BOOL" and not placed.dims:
                offset, bit = divmod(bits, 8)
                bits += 1
            else:
                offset, bit = _up(_up(bits, 8) // 8, extent.align), None
                bits = (offset + extent.size) * 8
            segment = encode_segment(member.name)
            own = len(segment) + 1 + len(member.comment) + len(member.initial or "")
            cost = cost.plus(extent.cost, 1, own)
            height = max(height, extent.height + 1)
            fields[member.name.lower()] = Field(segment, member, placed, offset, bit)
            good = good and self._fits(member.position, _up(bits, 8) // 8, cost, height)
        return Group(fields, _up(_up(bits, 8) // 8, 2), cost, height) if good else None

    def named(self, name: Named, depth: int = 0) -> ElementType | Group | None:
        """Look a type up: an elementary one, else a user's; None if it cannot be had, which is reported."""
        if not name.quoted and (element := element_type(name.name)):
            return element
        key = name.name.lower()
        if key in self._open:
            chain = " → ".join([*self._open[self._open.index(key) :], key])
            self._refuse(name.position, f"the type {name.name!r} contains itself: {chain}")
            return None
        if key not in self._placed:
            declaration = self._types.get(key)
            if declaration is None:
                self._refuse(name.position, self._unknown(name))
                return None
            self._open.append(key)
            self._placed[key] = self.struct(declaration.body, max(depth, 1))
            self._open.pop()
        return self._placed[key]

    def _member(self, member: Member, fields: dict[str, Field], depth: int) -> Leaf | Group | Repeat | None:
        first = fields.get(member.name.lower())
        if first is not None:
            where = f"line {first.member.position.line}"
            self._refuse(member.position, f"expected a new name, found {member.name!r} again ({where})")
            return None
        if len(member.name) > MAX_NAME:
            self._refuse(member.position, f"a name is at most {MAX_NAME} characters long")
            return None
        placed = self._type(member.type, depth + 1)
        if member.initial is not None and isinstance(placed, Group | Repeat):
            warning = f"the initial value of the structure {member.name!r} is not read; assign its members"
            self._report.add(member.position.warning(warning))
        return placed

    def _type(self, type_: Type, depth: int) -> Leaf | Group | Repeat | None:
        inner = type_.element if isinstance(type_, Array) else type_
        dims = type_.dims if isinstance(type_, Array) else ()
        found = self.named(inner, depth) if isinstance(inner, Named) else self.struct(inner, depth)
        if isinstance(found, Group):
            return Repeat(found, dims) if dims else found
        if found is None:
            return None
        leaf = Leaf(found, dims, 0)
        return Leaf(found, dims, array_size(found, leaf.shape))

    def _fits(self, position: Position, size: int, cost: Cost, height: int) -> bool:
        for what, value, limit in (
            ("bytes", size, MAX_BLOCK_BYTES),
            ("registers", cost.registers, MAX_REGISTERS),
            ("elements of arrays", cost.elements, MAX_ELEMENTS),
            ("characters of names, comments and values", cost.text, MAX_TEXT),
            ("levels of structures", height, MAX_DEPTH),
        ):
            if value > limit:
                self._refuse(position, f"expected at most {limit} {what}; up to this member there are {value}")
                return False
        return True

    def _unknown(self, name: Named) -> str:
        if name.name.upper() in SYSTEM_TYPES:
            return (
                f"the system type {name.name} is not supported: its placement in a block with standard access "
                "has no public source"
            )
        if name.name.lower() in self._skipped:
            return f"{name.name!r} is a function block; instance data blocks are not supported"
        return (
            f"expected a known type, found {name.name!r}; if it is a PLC data type, name its .udt file as well "
            "(instances of function blocks are not supported)"
        )

    def _refuse(self, position: Position, message: str) -> None:
        """Report an error."""
        self._report.add(position.error(message))


@dataclass(frozen=True, slots=True)
class _Extent:
    size: int
    align: int
    cost: Cost
    height: int


def _extent(placed: Leaf | Group | Repeat) -> _Extent:
    """Return what a member takes: bytes with padding, alignment in bytes, and what its expansion needs."""
    if isinstance(placed, Leaf):
        cost = Cost(1, math.prod(placed.shape))
        if placed.dims:
            return _Extent(_up(placed.size, 2), 2, cost, 0)
        return _Extent(placed.size, placed.element.align, cost, 0)
    if isinstance(placed, Group):
        return _Extent(placed.size, 2, placed.cost, placed.height)
    group, count = placed.group, math.prod(high - low + 1 for low, high in placed.dims)
    index_text = sum(1 + max(len(str(low)), len(str(high))) for low, high in placed.dims)
    return _Extent(count * group.size, 2, Cost().plus(group.cost, count, index_text), group.height)


def _up(value: int, step: int) -> int:
    return -(-value // step) * step
