"""Members, types and constants: the part of the grammar that data blocks, types and function blocks share."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from shmio.layout.cursor import Cursor, SyntaxFault
from shmio.layout.expression import bound, bounds, string_length
from shmio.layout.lexer import Kind
from shmio.layout.model import MAX_DEPTH
from shmio.layout.syntax import Array, ConstantDeclaration, Member, Named, Position, Section, Struct, Type

TOP = ("DATA_BLOCK", "TYPE", "FUNCTION", "FUNCTION_BLOCK", "ORGANIZATION_BLOCK")
INTERFACE = {section.value: section for section in Section}
SECTIONS = (*INTERFACE, "VAR_RETAIN", "VAR_TEMP", "CONST", "LABEL")
BLOCK_SECTIONS = ("VAR", "VAR_RETAIN")
_SECTION_WORDS = ("RETAIN", "NON_RETAIN", "DB_SPECIFIC")
STOPS = ("END_STRUCT", "END_VAR", "END_CONST", "END_TYPE", "END_DATA_BLOCK", "END_FUNCTION_BLOCK", "BEGIN", *TOP)
_NUMBERED = ("UDT", "FB", "SFB")
_SPACED = "the name {!r} has spaces and no quotes (as in print, where underscores can be lost); it is kept as written"
_PLAIN = re.compile(r"\w+")


class Declarations:
    """Reads declarations at a cursor. ``interface``: those of a function block, whose names have no spaces."""

    def __init__(self, cursor: Cursor) -> None:
        self.at = cursor
        self.interface = False

    def sections(self) -> tuple[Struct, tuple[ConstantDeclaration, ...]]:
        """Read a body: one STRUCT, or sections one after the other; return its members and its constants.

        The members of a function block come in the order of its instances.
        """
        position = self.at.position
        if self.at.accept_word("STRUCT"):
            return Struct(self.members("END_STRUCT", 0), position), ()
        members: list[Member] = []
        constants: list[ConstantDeclaration] = []
        while self.at.token.is_word(*(SECTIONS if self.interface else BLOCK_SECTIONS)):
            keyword = self.at.advance().text.upper()
            if keyword in ("VAR_TEMP", "LABEL"):  # they take no room in an instance
                end = "END_VAR" if keyword == "VAR_TEMP" else "END_LABEL"
                if not self.at.skip_to(end):
                    raise self.at.expected(end)
                self.at.advance()
            elif keyword == "CONST" or (self.at.token.is_word("CONSTANT") and not self.at.names_member()):
                self.at.accept_word("CONSTANT")
                constants += self.constants("END_CONST" if keyword == "CONST" else "END_VAR")
            else:
                while self.at.token.is_word(*_SECTION_WORDS) and not self.at.names_member():
                    self.at.advance()
                section = INTERFACE.get(keyword, Section.STATIC) if self.interface else None
                members += (replace(member, section=section) for member in self.members("END_VAR", 0))
            self.at.accept(";")
        if self.interface:
            order = list(Section)
            members.sort(key=lambda member: order.index(member.section or Section.STATIC))
        return Struct(tuple(members), position), tuple(constants)

    def constants(self, end: str) -> list[ConstantDeclaration]:
        """Read constants up to the END of their section."""
        constants: list[ConstantDeclaration] = []
        while not self.at.accept_word(end):
            if self.stops():
                raise self.at.expected(f"a constant or {end}")
            self.recovering(lambda: self._constant(constants))
        return constants

    def _constant(self, constants: list[ConstantDeclaration]) -> None:
        if self.at.accept(";"):
            return
        name, position, _ = self._name()
        if self.at.token.is_punct("{"):
            self.attributes()
        if self.at.accept(":"):  # classic SCL gives no type
            self._type(0)
        self.at.expect(":=", "':=' and the constant's value")
        start, number = self.at.index, None
        with suppress(SyntaxFault):  # a constant of another kind
            number = bound(self.at, "a number")
        if not self.at.token.is_punct(";"):
            number = None
        self.at.rewind(start)
        value = self.at.value()
        self.at.expect(";", "';' after the value")
        constants.append(ConstantDeclaration(name, value, number, position))

    def members(self, end: str, depth: int) -> tuple[Member, ...]:
        """Read members up to the END of their structure or section."""
        members: list[Member] = []
        while self.at.names_member() or not self.at.accept_word(end):
            if self.stops():
                raise self.at.expected(f"a member or {end}")
            self.recovering(lambda: self._member(members, depth))
        return tuple(members)

    def stops(self) -> bool:
        """Whether a list of members ends here for want of its END."""
        token = self.at.token
        return token.kind is Kind.END or (token.is_word(*STOPS) and not self.at.names_member())

    def recovering(self, read: Callable[[], None]) -> None:
        """Run one production; on a fault report it and skip to the end of the statement."""
        start = self.at.index
        try:
            read()
        except SyntaxFault as fault:
            self.at.report.add(fault.diagnostic)
            if self.at.index == start:
                self.at.advance()
            depth = 0
            while not (self.stops() if depth == 0 else self.at.token.kind is Kind.END):
                token = self.at.advance()
                depth += token.is_word("STRUCT") - token.is_word("END_STRUCT")
                if token.is_punct(";") and depth == 0:
                    return

    def attributes(self) -> dict[str, str]:
        """Read ``{ name := 'value'; … }``; names in upper case, values without quotes."""
        opening = self.at.advance()
        values: dict[str, str] = {}
        while not self.at.accept("}"):
            token = self.at.token
            if token.kind is Kind.END or token.is_punct("{") or token.is_word(*STOPS):
                raise self.at.fault(opening, "the attributes that begin here have no '}'")
            self.at.advance()
            if token.kind in (Kind.WORD, Kind.QUOTED) and self.at.accept(":="):
                values[token.text.upper()] = self.at.token.text.strip("'")
        return values

    def _member(self, members: list[Member], depth: int) -> None:
        if self.at.accept(";"):
            return
        names = [self._name()]
        while self.at.accept(","):
            names.append(self._name())
        if self.at.token.is_punct("{"):
            self.attributes()
        is_view = self.interface and self.at.accept_word("AT")  # another view of a member: it takes no room
        if is_view:
            self._name()
        self.at.expect(":", "':' and the type")
        for name, position, quoted in names:
            if not quoted and not _PLAIN.fullmatch(name):
                self.at.report.add(position.warning(_SPACED.format(name)))
        first = self.at.index
        type_ = self._type(depth)
        if self.at.token.is_punct("{"):
            self.attributes()
        initial = self.at.value() if self.at.accept(":=") else None
        closing = self.at.token
        inner = isinstance(type_, Struct) or (isinstance(type_, Array) and isinstance(type_.element, Struct))
        if not self.at.accept(";") and not (inner and initial is None):
            raise self.at.expected("';' at the end of the declaration")
        comment = "" if inner else closing.comment or self.at.last_comment(first)
        if not is_view:
            members += [Member(name, type_, comment, initial, position) for name, position, _ in names]

    def _name(self) -> tuple[str, Position, bool]:
        """Read a name; return it, its place, and whether it was in quotes."""
        position, token = self.at.position, self.at.token
        if token.kind is Kind.QUOTED:
            return self.at.advance().text, position, True
        if token.kind is not Kind.WORD:
            raise self.at.expected("a member's name")
        return self.at.advance().text if self.interface else self.at.words(), position, False

    def body_type(self) -> Type:
        """Read what stands for the body of a data block: the name of a type."""
        return self._type(0)

    def _type(self, depth: int) -> Type:
        position = self.at.position
        if not self.at.accept_word("ARRAY"):
            return self._element(depth)
        dims = bounds(self.at)
        self.at.expect_word("OF")
        if self.at.token.is_word("ARRAY"):
            raise self.at.expected("the type of an element; an array of arrays is one array with more dimensions")
        return Array(dims, self._element(depth), position)

    def _element(self, depth: int) -> Named | Struct:
        position, token = self.at.position, self.at.token
        if depth + 1 >= MAX_DEPTH and token.is_word("STRUCT"):
            raise self.at.fault(token, f"structures are nested more than {MAX_DEPTH} deep")
        if self.at.accept_word("STRUCT"):
            errors = len(self.at.report.errors)
            members = self.members("END_STRUCT", depth + 1)
            if not members and len(self.at.report.errors) == errors:
                raise self.at.fault(token, "expected at least one member in the structure")
            return Struct(members, position)
        if token.kind is Kind.QUOTED:
            self.at.advance()
            return Named(token.text, True, position)
        if token.kind is not Kind.WORD or token.is_word(*STOPS, *SECTIONS):
            raise self.at.expected("a type")
        self.at.advance()
        if token.is_word("STRING", "WSTRING"):
            return Named(token.text.upper(), False, position, string_length(self.at, token.text.upper()))
        if token.is_word(*_NUMBERED) and self.at.token.kind is Kind.NUMBER:
            return Named(token.text + self.at.advance().text, False, position)  # UDT 10 is UDT10
        return Named(token.text, False, position)
