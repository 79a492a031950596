"""Tokens to declarations, by recursive descent.

A syntax error is reported and the parser goes on at the next ``;`` or ``END_…``, so that one run finds them all.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from shmio.layout.cursor import Cursor, SyntaxFault
from shmio.layout.lexer import Kind, Token
from shmio.layout.model import MAX_DEPTH, MAX_DIMENSIONS, Dims
from shmio.layout.report import Report
from shmio.layout.syntax import (
    Array,
    Assignment,
    BlockDeclaration,
    Member,
    Named,
    Position,
    Struct,
    Type,
    TypeDeclaration,
    Unit,
)
from shmio.layout.types import DEFAULT_STRING, string_limit

_HEADER = (
    *("AUTHOR", "FAMILY", "NAME", "VERSION"),
    *("KNOW_HOW_PROTECT", "UNLINKED", "READ_ONLY", "NON_RETAIN", "RETAIN"),
)
_SECTION = ("VAR", "VAR_RETAIN")
_SECTION_WORDS = ("RETAIN", "NON_RETAIN", "CONSTANT", "DB_SPECIFIC")
_TOP = ("DATA_BLOCK", "TYPE", "FUNCTION", "FUNCTION_BLOCK", "ORGANIZATION_BLOCK")
_STOPS = ("END_STRUCT", "END_VAR", "END_TYPE", "END_DATA_BLOCK", "BEGIN", *_TOP)
_SPACED = "the name {!r} has spaces and no quotes (as in print, where underscores can be lost); it is kept as written"
_DB_NUMBER = re.compile(r"DB([1-9][0-9]{0,4})", re.IGNORECASE)


def parse(file: str, text: str, tokens: list[Token], report: Report) -> Unit:
    """Parse one file; what could not be understood is in the report and left out of the result."""
    return _Parser(Cursor(file, text, tokens), report).unit()


class _Parser:
    def __init__(self, cursor: Cursor, report: Report) -> None:
        self.at = cursor
        self.report = report

    # -- files and blocks ------------------------------------------------------------------------------------

    def unit(self) -> Unit:
        unit = Unit()
        while not self.at.at_end():
            try:
                if self.at.accept_word("DATA_BLOCK"):
                    unit.blocks.append(self.block())
                elif self.at.accept_word("TYPE"):
                    unit.types.append(self.type_declaration())
                elif self.at.token.is_word("FUNCTION", "FUNCTION_BLOCK", "ORGANIZATION_BLOCK"):
                    self.code_block(unit)
                elif not self.at.accept(";"):
                    raise self.at.expected("DATA_BLOCK or TYPE")
            except SyntaxFault as fault:
                self.report.add(fault.diagnostic)
                while not self.at.at_end() and not self.at.token.is_word(*_TOP):
                    self.at.advance()
        return unit

    def block(self) -> BlockDeclaration:
        position = self.at.position
        name, quoted = self.block_name("the block's name")
        match = None if quoted else _DB_NUMBER.fullmatch(name)
        number = int(match[1]) if match and int(match[1]) <= 65_535 else None
        optimized = self.header()
        body = self.sections() if self.at.token.is_word("STRUCT", *_SECTION) else self.type_(0)
        self.at.accept(";")
        assignments: list[Assignment] = []
        if self.at.accept_word("BEGIN"):
            while not self.at.token.is_word("END_DATA_BLOCK", *_TOP) and self.at.token.kind is not Kind.END:
                self.recovering(lambda: self.assignment(assignments))
        self.at.expect_word("END_DATA_BLOCK")
        return BlockDeclaration(name, number, optimized, body, tuple(assignments), position)

    def type_declaration(self) -> TypeDeclaration:
        position = self.at.position
        name, _ = self.block_name("the type's name")
        self.header()
        if not self.at.token.is_word("STRUCT"):
            raise self.at.expected("STRUCT")
        errors = len(self.report.errors)
        body = self.sections()
        if not body.members and len(self.report.errors) == errors:
            self.report.add(position.error(f"expected at least one member in the type {name!r}"))
        self.at.accept(";")
        self.at.expect_word("END_TYPE")
        return TypeDeclaration(name, body, position)

    def block_name(self, what: str) -> tuple[str, bool]:
        token = self.at.token
        if token.kind not in (Kind.WORD, Kind.QUOTED):
            raise self.at.expected(what)
        self.at.advance()
        name = token.text
        if token.is_word("DB", "UDT") and self.at.token.kind is Kind.NUMBER:
            name += self.at.advance().text  # DB 10 is DB10
        return name, token.kind is Kind.QUOTED

    def header(self) -> bool:
        """Skip what stands between a block's name and its body; return whether it says optimized."""
        optimized = False
        while True:
            if self.at.token.is_punct("{"):
                optimized |= self.attributes().get("S7_OPTIMIZED_ACCESS", "").upper() == "TRUE"
            elif self.at.token.is_word(*_HEADER):
                word = self.at.advance()
                if self.at.accept(":") or self.at.accept("="):
                    while self.at.token.line == word.line and not self.at.token.is_word("STRUCT", "VAR", "BEGIN"):
                        if self.at.advance().kind is Kind.END:
                            break
            else:
                return optimized

    def attributes(self) -> dict[str, str]:
        """Read ``{ name := 'value'; … }``; names in upper case, values without quotes."""
        opening = self.at.advance()
        values: dict[str, str] = {}
        while not self.at.accept("}"):
            token = self.at.token
            if token.kind is Kind.END or token.is_punct("{") or token.is_word(*_STOPS):
                raise self.at.fault(opening, "the attributes that begin here have no '}'")
            self.at.advance()
            if token.kind in (Kind.WORD, Kind.QUOTED) and self.at.accept(":="):
                values[token.text.upper()] = self.at.token.text.strip("'")
        return values

    def code_block(self, unit: Unit) -> None:
        start = self.at.token
        end = f"END_{self.at.advance().text.upper()}"
        name = self.at.token.text
        while not self.at.accept_word(end):
            if self.at.token.kind is Kind.END:
                raise self.at.fault(start, f"{start.text} has no {end}")
            self.at.advance()
        unit.skipped.append(name)
        self.report.add(self.at.at(start).warning(f"{start.text} {name!r} declares no data block and is skipped"))

    # -- members ---------------------------------------------------------------------------------------------

    def sections(self) -> Struct:
        """Read a body: one STRUCT, or VAR sections one after the other."""
        position = self.at.position
        if self.at.accept_word("STRUCT"):
            return Struct(self.members("END_STRUCT", 0), position)
        members: list[Member] = []
        while self.at.accept_word(*_SECTION):
            while self.at.token.is_word(*_SECTION_WORDS) and not self.at.names_member():
                if self.at.advance().text.upper() == "CONSTANT":
                    raise self.at.expected("a section of variables, not of constants")
            members += self.members("END_VAR", 0)
            self.at.accept(";")
        return Struct(tuple(members), position)

    def members(self, end: str, depth: int) -> tuple[Member, ...]:
        members: list[Member] = []
        while self.at.names_member() or not self.at.accept_word(end):
            if self.stops():
                raise self.at.expected(f"a member or {end}")
            self.recovering(lambda: self.member(members, depth))
        return tuple(members)

    def stops(self) -> bool:
        """Whether a list of members ends here for want of its END."""
        token = self.at.token
        return token.kind is Kind.END or (token.is_word(*_STOPS) and not self.at.names_member())

    def recovering(self, read: Callable[[], None]) -> None:
        """Run one production; on a fault report it and skip to the end of the statement."""
        start = self.at.index
        try:
            read()
        except SyntaxFault as fault:
            self.report.add(fault.diagnostic)
            if self.at.index == start:
                self.at.advance()
            depth = 0
            while not (self.stops() if depth == 0 else self.at.token.kind is Kind.END):
                token = self.at.advance()
                depth += token.is_word("STRUCT") - token.is_word("END_STRUCT")
                if token.is_punct(";") and depth == 0:
                    return

    def member(self, members: list[Member], depth: int) -> None:
        if self.at.accept(";"):
            return
        names = [self.member_name()]
        while self.at.accept(","):
            names.append(self.member_name())
        if self.at.token.is_punct("{"):
            self.attributes()
        self.at.expect(":", "':' and the type")
        for name, position, quoted in names:
            if not quoted and " " in name:
                self.report.add(position.warning(_SPACED.format(name)))
        first = self.at.index
        type_ = self.type_(depth)
        if self.at.token.is_punct("{"):
            self.attributes()
        initial = self.at.value() if self.at.accept(":=") else None
        closing = self.at.token
        if not self.at.accept(";") and not (isinstance(type_, Struct) and closing.is_word("END_STRUCT")):
            raise self.at.expected("';' at the end of the declaration")
        inner = isinstance(type_, Struct) or (isinstance(type_, Array) and isinstance(type_.element, Struct))
        comment = "" if inner else closing.comment or self.at.last_comment(first)
        members += [Member(name, type_, comment, initial, position) for name, position, _ in names]

    def member_name(self) -> tuple[str, Position, bool]:
        """Read a name; return it, its place, and whether it was in quotes."""
        position, token = self.at.position, self.at.token
        if token.kind is Kind.QUOTED:
            return self.at.advance().text, position, True
        if token.kind is not Kind.WORD:
            raise self.at.expected("a member's name")
        return self.at.words(), position, False

    # -- types -----------------------------------------------------------------------------------------------

    def type_(self, depth: int) -> Type:
        position = self.at.position
        if not self.at.accept_word("ARRAY"):
            return self.element(depth)
        dims = self.dimensions()
        self.at.expect_word("OF")
        if self.at.token.is_word("ARRAY"):
            raise self.at.expected("the type of an element; an array of arrays is one array with more dimensions")
        return Array(dims, self.element(depth), position)

    def element(self, depth: int) -> Named | Struct:
        position, token = self.at.position, self.at.token
        if depth + 1 >= MAX_DEPTH and token.is_word("STRUCT"):
            raise self.at.fault(token, f"structures are nested more than {MAX_DEPTH} deep")
        if self.at.accept_word("STRUCT"):
            errors = len(self.report.errors)
            members = self.members("END_STRUCT", depth + 1)
            if not members and len(self.report.errors) == errors:
                raise self.at.fault(token, "expected at least one member in the structure")
            return Struct(members, position)
        if token.kind is Kind.QUOTED:
            self.at.advance()
            return Named(token.text, True, position)
        if token.kind is not Kind.WORD or token.is_word(*_STOPS, *_SECTION):
            raise self.at.expected("a type")
        self.at.advance()
        name = token.text
        if token.is_word("STRING", "WSTRING"):
            name = f"{name.upper()}[{self.string_length(name.upper())}]"
        elif token.is_word("UDT") and self.at.token.kind is Kind.NUMBER:
            name += self.at.advance().text  # UDT 10 is UDT10
        return Named(name, False, position)

    def string_length(self, base: str) -> int:
        if not (self.at.token.is_punct("[") or self.at.token.is_punct("(")):
            return DEFAULT_STRING
        closing = "]" if self.at.advance().text == "[" else ")"
        token = self.at.token
        length = self.integer("the string's length")
        if not 1 <= length <= string_limit(base):
            raise self.at.fault(token, f"expected a {base} length of 1 to {string_limit(base)}, found {token}")
        self.at.expect(closing, f"'{closing}' after the string's length")
        return length

    def dimensions(self) -> Dims:
        self.at.expect("[", "'[' and the bounds of the array")
        dims: list[tuple[int, int]] = []
        while True:
            start = self.at.token
            low = self.integer("the lower bound")
            self.at.expect("..", "'..' between the bounds")
            high = self.integer("the upper bound")
            if low > high:
                raise self.at.fault(start, f"expected a lower bound not above the upper, found {low}..{high}")
            dims.append((low, high))
            if not self.at.accept(","):
                break
            if len(dims) == MAX_DIMENSIONS:
                raise self.at.fault(start, f"an array has at most {MAX_DIMENSIONS} dimensions")
        self.at.expect("]", "']' after the bounds")
        return tuple(dims)

    def integer(self, what: str) -> int:
        """Read a whole number that fits a DINT, as Siemens demands of bounds."""
        start = self.at.token
        sign = -1 if self.at.accept("-") else 1
        if sign == 1:
            self.at.accept("+")
        token = self.at.token
        if token.kind in (Kind.WORD, Kind.QUOTED):
            raise self.at.expected(f"{what} as a number; constants are not known here")
        digits = token.text.replace("_", "")
        if token.kind is not Kind.NUMBER or not digits.isdecimal():
            raise self.at.expected(f"{what}, a whole number")
        self.at.advance()
        if len(digits) > 10 or not -(1 << 31) <= sign * int(digits) < 1 << 31:
            raise self.at.fault(start, f"expected {what} within 32 bits, found {token}")
        return sign * int(digits)

    # -- BEGIN -----------------------------------------------------------------------------------------------

    def assignment(self, assignments: list[Assignment]) -> None:
        if self.at.accept(";"):
            return
        position = self.at.position
        target: list[str | tuple[int, ...]] = []
        while True:
            token = self.at.token
            if token.kind is Kind.QUOTED:
                target.append(self.at.advance().text)
            elif token.kind is Kind.WORD:
                target.append(self.at.words())
            else:
                raise self.at.expected("a member's name")
            if self.at.accept("["):
                index = [self.integer("an index")]
                while self.at.accept(","):
                    index.append(self.integer("an index"))
                self.at.expect("]", "']' after the index")
                target.append(tuple(index))
            if not self.at.accept("."):
                break
        self.at.expect(":=", "':=' and a value")
        value = self.at.value()
        self.at.expect(";", "';' after the value")
        assignments.append(Assignment(tuple(target), value, position))
