"""Compute the offset of each declared member, by Siemens' rules for blocks with standard access.

- BOOL takes the next bit; anything else begins at the next whole byte.
- One-byte types take the next byte; all wider types, strings included, begin at an even byte.
- Arrays and structures begin at an even byte and are padded to an even length.
- So do the sections of an instance of a function block: inputs, outputs, in-outs, static members.
  An in-out of a structured type is a POINTER to the caller's argument.

Each type is placed once, however often it is used. Before ``emit.py`` expands the structures to
registers, this module checks the size of the result. ``docs/reference/layout-rules.md`` gives the
rules with their evidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from shmio.errors import Diagnostic
from shmio.layout.model import (
    BYTE,
    MAX_BLOCK_BYTES,
    MAX_DEPTH,
    MAX_ELEMENTS,
    MAX_REGISTERS,
    MAX_STRUCTURES,
    POINTER,
    STRUCTURED,
    Dims,
    ElementType,
    array_size,
    element_type,
    shape_of,
    string_limit,
)
from shmio.layout.report import Report
from shmio.layout.source import system_types
from shmio.layout.source.constants import BoundFault, Constants
from shmio.layout.source.syntax import Array, Bounds, Member, Named, Position, Section, Struct, Type, TypeDeclaration
from shmio.layout.topic import encode_segment
from shmio.wording import MAX_NAMES

_MAX_NAME = 128  # characters, as in TIA Portal
MAX_TEXT = 32 << 20  # characters of all expanded paths, comments and initial values together
_OPAQUE = (
    "the system type '{name}' is kept as {size} bytes without meaning, because its members are not public; "
    'if you know them, declare it as a PLC data type, TYPE "{name}" STRUCT … END_STRUCT; END_TYPE'
)
_NO_PLACE: Final = "left out, because their addresses are not known"
_SIZE = 'type_bytes = {{ "{name}" = … }} in the configuration, or --type-bytes "{name}=…" of shmio-layout'


def is_of_left_out(warning: Diagnostic) -> bool:
    """Return whether a warning names members that are left out, because their addresses are not known."""
    return warning.message.startswith(_NO_PLACE)


@dataclass(frozen=True, slots=True)
class Leaf:
    """The type of a register: an elementary type, or an array of one. ``size`` is in bytes, without padding."""

    element: ElementType
    dims: Dims
    size: int

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of elements in each dimension."""
        return shape_of(self.dims)


@dataclass(frozen=True, slots=True)
class Group:
    """A placed structure.

    Attributes:
        fields: The members by name in lower case, because S7 names are case-insensitive.
        size: Size in bytes, always even.
        cost: Cost of the expansion.
        height: Number of levels of structures.
        opaque: True if the members are unknown.
        names: Names of all members in lower case, in order, if some have no field; else ().
        open: The member type because of which the size is unknown, and ``size`` is only that of the
            first members; None if the size is known.

    """

    fields: dict[str, Field]
    size: int
    cost: Cost
    height: int
    opaque: bool = False
    names: tuple[str, ...] = ()
    open: Unknown | None = None


@dataclass(frozen=True, slots=True)
class Unknown:
    """A type whose members and size are unknown; ``why`` says what to do about it."""

    why: Diagnostic


@dataclass(frozen=True, slots=True)
class Repeat:
    """An array of structures."""

    group: Group
    dims: Dims


@dataclass(frozen=True, slots=True)
class Field:
    """A member of a structure. ``offset`` is in bytes from the structure's start. Only a single BOOL has a ``bit``."""

    segment: str
    member: Member
    type: Leaf | Group | Repeat
    offset: int
    bit: int | None


@dataclass(frozen=True, slots=True)
class Cost:
    """The size of what the expansion of a type yields: numbers of registers, elements, characters and structures."""

    registers: int = 0
    elements: int = 0
    text: int = 0
    structures: int = 0

    def plus(self, inner: Cost, times: int, text_each: int) -> Cost:
        """Return this cost plus ``times`` the cost ``inner``.

        ``text_each`` is the number of characters by which each inner register's path gets longer.
        """
        return Cost(
            self.registers + times * inner.registers,
            self.elements + times * inner.elements,
            self.text + times * (inner.text + inner.registers * text_each),
            self.structures + times * inner.structures,
        )


@dataclass(frozen=True, slots=True)
class _Extent:
    """The space that a member takes, and the cost of its expansion.

    ``size`` (with padding) and ``align`` are in bytes. ``height`` is the number of levels of
    structures in the member's type.
    """

    size: int
    align: int
    cost: Cost
    height: int


def _extent_of(placed: Leaf | Group | Repeat) -> _Extent:
    """Return the extent of a member that has this placed type."""
    if isinstance(placed, Leaf):
        cost = Cost(1, math.prod(placed.shape))
        if placed.dims:
            return _Extent(_round_up(placed.size, 2), 2, cost, 0)
        return _Extent(placed.size, placed.element.align, cost, 0)
    if isinstance(placed, Group):
        return _Extent(placed.size, 2, Cost(structures=1).plus(placed.cost, 1, 0), placed.height)
    group, count = placed.group, math.prod(shape_of(placed.dims))
    index_text = sum(1 + max(len(str(low)), len(str(high))) for low, high in placed.dims)
    cost = Cost(elements=count, structures=count).plus(group.cost, count, index_text)
    return _Extent(count * group.size, 2, cost, group.height)


class Placer:
    """Places structures.

    User types are looked up by name, and each is placed when it is first used.
    """

    def __init__(
        self,
        types: Mapping[str, TypeDeclaration],
        constants: Constants,
        report: Report,
        type_bytes: Mapping[str, int] | None = None,
        *,
        by_name: bool = False,
    ) -> None:
        """Create a placer.

        Args:
            types: The user types, by name in lower case.
            constants: The constants of all sources.
            report: Receives errors and warnings.
            type_bytes: Sizes in bytes of types whose members are unknown, by name.
            by_name: True if the members are read by their names. Then their places have no meaning, and
                no type needs a size.

        """
        self._types = types
        self._by_name = by_name
        self._type_bytes = {name.lower(): size for name, size in (type_bytes or {}).items()}
        self._global = self._constants = constants
        self._report = report
        self.placed: dict[str, Group | Unknown | None] = {}
        """The placed types by name in lower case; None for a type with errors."""
        self._of_unit: dict[str, str] = {}
        """For a type whose source names no software unit, the name with the unit by which a member has it."""
        self._open: dict[str, str] = {}  # names of the types that are being placed, by key

    def block(self, struct: Struct, constants: Constants) -> Group | None:
        """Place the body of a block, with the constants that are visible in it."""
        self._constants = constants
        return self.struct(struct)

    def struct(self, struct: Struct, depth: int = 0) -> Group | None:
        """Place a structure; report errors, and return None if there are any.

        Only the body of a block may be without members. For any other structure without members,
        the parser has already reported an error.
        """
        if depth and not struct.members:
            return None
        if depth >= MAX_DEPTH:
            self._refuse(struct.position, f"structures are nested more than {MAX_DEPTH} deep")
            return None
        fields: dict[str, Field] = {}
        bits = height = 0
        cost = Cost()
        good, complete = True, True
        cause: Unknown | None = None
        lost: list[Member] = []  # members whose places depend on the size of the cause
        section: Section | None = None
        for member in struct.members:
            if member.section is not section:
                section, bits = member.section, _round_up(bits, 16)
            if _takes_no_room(member):
                continue
            placed = self._member(member, fields, depth)
            if placed is None:
                good = False
                continue
            if cause is not None:
                lost.append(member)
                continue
            unknown = _unknown_in(placed)
            if isinstance(placed, Unknown) or (unknown is not None and isinstance(placed, Repeat)):
                complete = False
                cause = None if self._by_name else unknown
                continue
            extent = _extent_of(placed)
            if isinstance(placed, Leaf) and placed.element.base == "BOOL" and not placed.dims:
                offset, bit = divmod(bits, 8)
                bits += 1
            else:
                offset, bit = _round_up(_round_up(bits, 8) // 8, extent.align), None
                bits = (offset + extent.size) * 8
            segment = encode_segment(member.name)
            initial = self._constants.substitute(member.initial)
            own = len(segment) + 1 + len(member.comment) + (len(initial or "") if isinstance(placed, Leaf) else 0)
            cost = cost.plus(extent.cost, 1, own)
            height = max(height, extent.height + 1)
            known = member if initial == member.initial else replace(member, initial=initial)
            fields[member.name.lower()] = Field(segment, known, placed, offset, bit)
            good = good and self._fits(member.position, _round_up(bits, 8) // 8, cost, height)
            if unknown is not None:
                complete, cause = False, unknown
        if not good:
            return None
        if lost:
            shown = ", ".join(repr(member.name) for member in lost[:MAX_NAMES])
            more = f" and {len(lost) - MAX_NAMES} more" if len(lost) > MAX_NAMES else ""
            self._report.add(lost[0].position.warning(f"{_NO_PLACE}: {shown}{more}"))
        names = tuple(member.name.lower() for member in struct.members) if not complete else ()
        return Group(fields, _round_up(_round_up(bits, 8) // 8, 2), cost, height, names=names, open=cause)

    def named(self, name: Named) -> ElementType | Group | Unknown | None:
        """Return the elementary or user type with a name; report an error and return None if there is none."""
        try:
            return self._named(name, 0)
        except BoundFault as fault:
            self._report.add(fault.diagnostic)
            return None

    def _named(self, name: Named, depth: int) -> ElementType | Group | Unknown | None:
        if not name.quoted and (element := self._elementary(name)):
            return element
        key = name.name.lower()
        if key not in self._types and (bare := key.rpartition(".")[2]) in self._types:  # its source names no unit
            first = self._of_unit.setdefault(bare, name.name)
            if first.lower() != key:
                what = f"the sources have one type {self._types[bare].name!r} for both {first!r} and {name.name!r}"
                unit, _, own = first.partition(".")
                self._refuse(
                    name.position, f'{what}; write the software unit in the source of each: TYPE "{unit}"."{own}"'
                )
                return None
            key = bare
        if key not in self.placed and key in self._type_bytes and not self._by_name:
            self.placed[key] = _opaque(name, self._type_bytes[key])
        if key in self._open:
            keys = [*self._open]
            chain = " → ".join([*keys[keys.index(key) :], key])
            self._refuse(name.position, f"the type {name.name!r} contains itself: {chain}")
            return None
        if key not in self.placed:
            declaration = self._types.get(key) or system_types.declarations().get(key)
            if declaration is None and self._by_name:
                declaration = system_types.named().get(key)
            if declaration is not None:
                self.placed[key] = self._declared(key, declaration, depth)
            elif (size := system_types.length(name.name)) and not self._by_name:
                self._report.add(name.position.warning(_OPAQUE.format(name=name.name, size=size)))
                self.placed[key] = _opaque(name, size)
            elif system_types.length(name.name) or system_types.refusal(name.name) or key in self._type_bytes:
                why = name.position.warning(self._left_out(name))
                self._report.add(why)
                self.placed[key] = Unknown(why)
            else:
                self._refuse(name.position, self._unknown(name))
                return None
        return self.placed[key]

    def _declared(self, key: str, declaration: TypeDeclaration, depth: int) -> Group | None:
        for fault in declaration.faults:
            self._report.add(fault)
        if declaration.faults and declaration.is_function_block:
            return None
        if not declaration.body.members and declaration.is_function_block:  # it stores nothing
            return Group({}, 0, Cost(), 0)
        if not declaration.body.members and not any(fault.severity == "error" for fault in declaration.faults):
            self._refuse(declaration.position, f"expected at least one member in the type {declaration.name!r}")
        outside, self._constants = self._constants, Constants(declaration.constants, self._global)
        self._open[key] = declaration.name
        group = self.struct(declaration.body, max(depth, 1))
        del self._open[key]
        self._constants = outside
        return group

    def _elementary(self, name: Named) -> ElementType | None:
        if name.length is None:
            return element_type(name.name)
        length = self._constants.number(name.length)
        if not 1 <= length <= string_limit(name.name):
            what = f"expected a {name.name} length of 1 to {string_limit(name.name)}, found {length}"
            raise BoundFault(name.position.error(what))
        return element_type(f"{name.name}[{length}]")

    def _member(self, member: Member, fields: dict[str, Field], depth: int) -> Leaf | Group | Repeat | Unknown | None:
        first = fields.get(member.name.lower())
        if first is not None:
            line = first.member.position.line
            self._refuse(member.position, f"{member.name!r} is declared twice, first in line {line}")
            return None
        if len(member.name) > _MAX_NAME:
            self._refuse(member.position, f"a name is at most {_MAX_NAME} characters long")
            return None
        if member.section is Section.IN_OUT and _is_structured(member.type):
            return Leaf(POINTER, (), POINTER.size)
        try:
            return self._type(member.type, depth + 1)
        except BoundFault as fault:
            self._report.add(fault.diagnostic)
            return None

    def _type(self, type_: Type, depth: int) -> Leaf | Group | Repeat | Unknown | None:
        inner = type_.element if isinstance(type_, Array) else type_
        dims = self._dims(type_.bounds, type_.position) if isinstance(type_, Array) else ()
        found = self._named(inner, depth) if isinstance(inner, Named) else self.struct(inner, depth)
        if isinstance(found, Group):
            return Repeat(found, dims) if dims else found
        if found is None or isinstance(found, Unknown):
            return found
        leaf = Leaf(found, dims, 0)
        return Leaf(found, dims, array_size(found, leaf.shape))

    def _dims(self, bounds: Bounds, position: Position) -> Dims:
        if not bounds:
            raise BoundFault(position.error("expected the bounds of the array, found '*', which has no fixed size"))
        dims = tuple((self._constants.number(low), self._constants.number(high)) for low, high in bounds)
        for low, high in dims:
            if low > high:
                raise BoundFault(position.error(f"expected a lower bound not above the upper, found {low}..{high}"))
        return dims

    def _fits(self, position: Position, size: int, cost: Cost, height: int) -> bool:
        for what, value, limit in (
            ("bytes", size, MAX_BLOCK_BYTES),
            ("registers", cost.registers, MAX_REGISTERS),
            ("elements of arrays", cost.elements, MAX_ELEMENTS),
            ("structures", cost.structures, MAX_STRUCTURES),
            ("characters of names, comments and values", cost.text, MAX_TEXT),
            ("levels of structures", height, MAX_DEPTH),
        ):
            if value > limit:
                where = f" in the type {[*self._open.values()][-1]!r}" if self._open else ""
                self._refuse(position, f"expected at most {limit} {what}{where}; up to this member there are {value}")
                return False
        return True

    def _left_out(self, name: Named) -> str:
        """Return the warning about a member of a system type whose members are unknown."""
        reason = system_types.refusal(name.name) or "its members are not public"
        if self._by_name:
            return (
                f"shmio does not know the members of the type {name.name}, and leaves out what has this type; "
                f'declare it as a PLC data type, TYPE "{name.name}" STRUCT … END_STRUCT; END_TYPE, to read it'
            )
        return (
            f"shmio does not know the members of the system type {name.name}: {reason}; it knows no "
            "addresses of them, nor of the members after them, because these depend on its size; declare it as a PLC "
            "data type, TYPE "
            f'"{name.name}" STRUCT … END_STRUCT; END_TYPE, or give only its size by {_SIZE.format(name=name.name)}, or '
            'read the block by OPC UA: connector = "opcua" with nodes = "siemens"'
        )

    def _unknown(self, name: Named) -> str:
        return (
            f"unknown type {name.name!r}; if it is a PLC data type or a function block, name its source (.udt, .scl, "
            f".awl, .s7dcl) as well; or give only its size by {_SIZE.format(name=name.name)}"
        )

    def _refuse(self, position: Position, message: str) -> None:
        """Report an error at this position."""
        self._report.add(position.error(message))


def _unknown_in(placed: Leaf | Group | Repeat | Unknown) -> Unknown | None:
    """Return the type because of which the size of a member is unknown; None if it is known."""
    if isinstance(placed, Unknown):
        return placed
    return placed.open if isinstance(placed, Group) else placed.group.open if isinstance(placed, Repeat) else None


def _opaque(name: Named, size: int) -> Group:
    """Return a structure of ``size`` bytes whose members are unknown."""
    at = name.position
    member = Member("bytes", Array(((0, size - 1),), Named("BYTE", False, at), at), "", None, at)
    leaf = Leaf(BYTE, ((0, size - 1),), size)
    cost = Cost().plus(_extent_of(leaf).cost, 1, len(member.name) + 1)
    return Group({member.name: Field(member.name, member, leaf, 0, None)}, _round_up(size, 2), cost, 1, opaque=True)


def _is_structured(type_: Type) -> bool:
    """Return whether an in-out of this type is passed as a pointer."""
    if not isinstance(type_, Named) or type_.quoted or type_.length is not None:
        return True
    element = element_type(type_.name)
    return element is None or element.base in STRUCTURED


def _takes_no_room(member: Member) -> bool:
    """Return whether the member is a VARIANT parameter, which an instance does not store."""
    type_ = member.type
    return (
        member.section in (Section.INPUT, Section.IN_OUT)
        and isinstance(type_, Named)
        and not type_.quoted
        and type_.name.upper() == "VARIANT"
    )


def _round_up(value: int, step: int) -> int:
    """Return the value rounded up to a multiple of ``step``."""
    return -(-value // step) * step
