"""Syntax tree of a source: declarations as written, before names are resolved or placed."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from shmio.errors import Diagnostic


@dataclass(frozen=True, slots=True)
class Position:
    """Place in a source, for diagnostics."""

    file: str
    line: int
    column: int

    def error(self, message: str) -> Diagnostic:
        """Return an error at this place."""
        return Diagnostic(self.file, self.line, self.column, message)

    def warning(self, message: str) -> Diagnostic:
        """Return a warning at this place."""
        return Diagnostic(self.file, self.line, self.column, message, "warning")


@dataclass(frozen=True, slots=True)
class Constant:
    """Reference to a constant by name."""

    name: str
    position: Position


@dataclass(frozen=True, slots=True)
class Sum:
    """A constant expression: signed terms, each a product of factors.

    Sums do not nest, so their depth needs no limit.
    """

    terms: tuple[tuple[int, tuple[int | Constant, ...]], ...]
    position: Position


Bound = int | Sum
Bounds = tuple[tuple[Bound, Bound], ...]


@dataclass(frozen=True, slots=True)
class Named:
    """Reference to a type by name: an elementary type, or a user type, whose name may be quoted.

    ``length`` is the length of a string type.
    """

    name: str
    quoted: bool
    position: Position
    length: Bound | None = None


@dataclass(frozen=True, slots=True)
class Struct:
    """An anonymous structure, the body of a type, or the body of a block."""

    members: tuple[Member, ...]
    position: Position


@dataclass(frozen=True, slots=True)
class Array:
    """An array; ``element`` is never an array.

    ``ARRAY[*]``, whose size the caller determines, has no bounds.
    """

    bounds: Bounds
    element: Named | Struct
    position: Position


Type = Named | Struct | Array


class Section(Enum):
    """The section in which a member is declared. An instance of a function block has the sections in this order."""

    INPUT = "VAR_INPUT"
    OUTPUT = "VAR_OUTPUT"
    IN_OUT = "VAR_IN_OUT"
    STATIC = "VAR"


@dataclass(frozen=True, slots=True)
class Member:
    """A member of a structure; ``initial`` is source text; ``section`` is set in function blocks."""

    name: str
    type: Type
    comment: str
    initial: str | None
    position: Position
    section: Section | None = None


@dataclass(frozen=True, slots=True)
class ConstantDeclaration:
    """``name : type := value;`` in a section of constants.

    ``number`` is the value as a bound, or None if it cannot be one.
    """

    name: str
    value: str
    number: Bound | None
    position: Position


@dataclass(frozen=True, slots=True)
class Assignment:
    """``target := value;`` after BEGIN; ``target`` consists of names and index lists as written."""

    target: tuple[str | tuple[int, ...], ...]
    value: str
    position: Position


@dataclass(frozen=True, slots=True)
class TypeDeclaration:
    """TYPE … END_TYPE, or the interface of a FUNCTION_BLOCK.

    ``faults`` are its errors. Those of a function block matter only if its type is used.
    """

    name: str
    body: Struct
    position: Position
    constants: tuple[ConstantDeclaration, ...] = ()
    is_function_block: bool = False
    optimized: bool = False
    faults: tuple[Diagnostic, ...] = ()


@dataclass(frozen=True, slots=True)
class BlockDeclaration:
    """DATA_BLOCK … END_DATA_BLOCK; ``body`` may be the name of a function block or a user type.

    ``faults`` are its errors and warnings, which matter only if the block is compiled.
    """

    name: str
    number: int | None
    optimized: bool
    body: Type
    constants: tuple[ConstantDeclaration, ...]
    assignments: tuple[Assignment, ...]
    position: Position
    faults: tuple[Diagnostic, ...] = ()


@dataclass(slots=True)
class Unit:
    """All declarations of one file."""

    types: list[TypeDeclaration] = field(default_factory=list)
    blocks: list[BlockDeclaration] = field(default_factory=list)
    constants: list[ConstantDeclaration] = field(default_factory=list)
