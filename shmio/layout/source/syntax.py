"""What the parser makes of a source: declarations as they are written, nothing resolved or placed."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from shmio.layout.model import Diagnostic


@dataclass(frozen=True, slots=True)
class Position:
    """Where something stands, for diagnostics."""

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
    """A constant by name."""

    name: str
    position: Position


@dataclass(frozen=True, slots=True)
class Sum:
    """A constant expression: terms with their signs, each a product. Flat, so that its depth has no bound to check."""

    terms: tuple[tuple[int, tuple[int | Constant, ...]], ...]
    position: Position


Bound = int | Sum
Bounds = tuple[tuple[Bound, Bound], ...]


@dataclass(frozen=True, slots=True)
class Named:
    """A type by name: elementary or of a user; quoted names are the user's. ``length`` is that of a string."""

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
    """An array; ``element`` is never an array itself. No bounds: ``ARRAY[*]``, which the caller decides."""

    bounds: Bounds
    element: Named | Struct
    position: Position


Type = Named | Struct | Array


class Section(Enum):
    """Where a member is declared, in the order in which a function block's instance holds them."""

    INPUT = "VAR_INPUT"
    OUTPUT = "VAR_OUTPUT"
    IN_OUT = "VAR_IN_OUT"
    STATIC = "VAR"


@dataclass(frozen=True, slots=True)
class Member:
    """One member; ``initial`` is the source's text. ``section`` is set in function blocks."""

    name: str
    type: Type
    comment: str
    initial: str | None
    position: Position
    section: Section | None = None


@dataclass(frozen=True, slots=True)
class ConstantDeclaration:
    """``name : type := value;`` in a section of constants. ``number`` is the value as a bound, if it can be one."""

    name: str
    value: str
    number: Bound | None
    position: Position


@dataclass(frozen=True, slots=True)
class Assignment:
    """``target := value;`` after BEGIN. The target is names and index lists in the order written."""

    target: tuple[str | tuple[int, ...], ...]
    value: str
    position: Position


@dataclass(frozen=True, slots=True)
class TypeDeclaration:
    """TYPE … END_TYPE, or the interface of a FUNCTION_BLOCK.

    ``faults`` is what is wrong with it: that matters only where the type is used.
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
    """DATA_BLOCK … END_DATA_BLOCK; the body of an instance or of a block of a UDT is that type's name.

    ``faults`` is what is wrong with it, and what is odd: that matters only if the block is asked for.
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
