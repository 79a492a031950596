"""What the parser makes of a source: declarations as they are written, nothing resolved or placed."""

from __future__ import annotations

from dataclasses import dataclass, field

from shmio.layout.model import Diagnostic, Dims


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
class Named:
    """A type by name: elementary (``STRING[20]`` with its length) or of a user; quoted names are the user's."""

    name: str
    quoted: bool
    position: Position


@dataclass(frozen=True, slots=True)
class Struct:
    """An anonymous structure, the body of a type, or the body of a block."""

    members: tuple[Member, ...]
    position: Position


@dataclass(frozen=True, slots=True)
class Array:
    """An array; ``element`` is never an array itself."""

    dims: Dims
    element: Named | Struct
    position: Position


Type = Named | Struct | Array


@dataclass(frozen=True, slots=True)
class Member:
    """One member; ``initial`` is the source's text."""

    name: str
    type: Type
    comment: str
    initial: str | None
    position: Position


@dataclass(frozen=True, slots=True)
class Assignment:
    """``target := value;`` after BEGIN. The target is names and index lists in the order written."""

    target: tuple[str | tuple[int, ...], ...]
    value: str
    position: Position


@dataclass(frozen=True, slots=True)
class TypeDeclaration:
    """TYPE … END_TYPE."""

    name: str
    body: Struct
    position: Position


@dataclass(frozen=True, slots=True)
class BlockDeclaration:
    """DATA_BLOCK … END_DATA_BLOCK; the body of a block of a UDT is that type's name."""

    name: str
    number: int | None
    optimized: bool
    body: Type
    assignments: tuple[Assignment, ...]
    position: Position


@dataclass(slots=True)
class Unit:
    """All declarations of one file."""

    types: list[TypeDeclaration] = field(default_factory=list)
    blocks: list[BlockDeclaration] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
