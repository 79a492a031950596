"""Tokens to declarations, by recursive descent: files, blocks and what is assigned after BEGIN.

A syntax error is reported and the parser goes on at the next ``;`` or ``END_…``, so that one run finds them all.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from shmio.layout.cursor import Cursor, SyntaxFault
from shmio.layout.declarations import BLOCK_SECTIONS, SECTIONS, TOP, Declarations
from shmio.layout.expression import integer
from shmio.layout.lexer import Kind, Token
from shmio.layout.report import MAX_ERRORS, Report, TooManyErrors
from shmio.layout.syntax import Assignment, BlockDeclaration, ConstantDeclaration, Struct, Type, TypeDeclaration, Unit

_HEADER = (
    *("AUTHOR", "FAMILY", "NAME", "VERSION", "CODE_VERSION1", "STANDARD"),
    *("KNOW_HOW_PROTECT", "UNLINKED", "READ_ONLY", "NON_RETAIN", "RETAIN"),
)
_NUMBERED = ("DB", "UDT", "FB", "FC", "OB", "SFB")
_DB_NUMBER = re.compile(r"DB([1-9][0-9]{0,4})", re.IGNORECASE)
_PROTECTED = (
    "the block {!r} is know-how protected and its declaration is not in the source: remove the protection in its "
    "properties and export it again, or write its members here"
)


def parse(file: str, text: str, tokens: list[Token], report: Report) -> Unit:
    """Parse one file; what could not be understood is in the report and left out of the result."""
    return _Parser(Cursor(file, text, tokens, report)).unit()


@dataclass(slots=True)
class _Header:
    """What stands between a block's name and its body."""

    optimized: bool = False
    protected: bool = False


class _Parser:
    def __init__(self, cursor: Cursor) -> None:
        self.at = cursor
        self.declare = Declarations(cursor)

    def unit(self) -> Unit:
        unit = Unit()
        while not self.at.at_end():
            try:
                if self.at.accept_word("DATA_BLOCK"):
                    unit.blocks.append(self.block())
                elif self.at.accept_word("TYPE"):
                    unit.types.append(self.type_declaration())
                elif self.at.accept_word("FUNCTION_BLOCK"):
                    unit.types.append(self.function_block())
                elif self.at.token.is_word("FUNCTION", "ORGANIZATION_BLOCK"):
                    self.code_block()
                elif self.at.accept_word("VAR"):
                    self.at.expect_word("CONSTANT")
                    unit.constants += self.declare.constants("END_VAR")
                elif not self.at.accept(";"):
                    raise self.at.expected("DATA_BLOCK, TYPE or FUNCTION_BLOCK")
            except SyntaxFault as fault:
                self.at.report.add(fault.diagnostic)
                self.resume()
        return unit

    def resume(self) -> None:
        """Go to where the next declaration begins."""
        while not self.at.at_end() and not self.at.token.is_word(*TOP):
            self.at.advance()

    @contextmanager
    def collecting(self, *, resume: bool = True) -> Iterator[Report]:
        """Collect what is wrong with one declaration: not every one is used. ``resume`` after it, if it is broken."""
        outer, inner = self.at.report, Report([self.at.file])
        self.at.report = inner
        with suppress(TooManyErrors):
            try:
                yield inner
            except SyntaxFault as fault:
                inner.add(fault.diagnostic)
                if resume:
                    self.resume()
        if resume and len(inner.errors) >= MAX_ERRORS:
            self.at.skip_to_any(*TOP)
        self.at.report = outer

    def block(self) -> BlockDeclaration:
        position = self.at.position
        name, quoted = self.block_name("the block's name")
        match = None if quoted else _DB_NUMBER.fullmatch(name)
        number = int(match[1]) if match and int(match[1]) <= 65_535 else None
        header = _Header()
        body: Type = Struct((), position)
        constants: tuple[ConstantDeclaration, ...] = ()
        assignments: list[Assignment] = []
        with self.collecting() as found:
            header = self.header()
            if header.protected and self.at.token.is_word("BEGIN", "END_DATA_BLOCK"):
                raise SyntaxFault(position.error(_PROTECTED.format(name)))
            if self.at.token.is_word("STRUCT", *BLOCK_SECTIONS):
                body, constants = self.declare.sections()
            else:
                body = self.declare.body_type()
                header = self.header(header)  # STEP 7 takes it on either side of the type's name
            self.at.accept(";")
            if self.at.accept_word("BEGIN"):
                while not self.at.token.is_word("END_DATA_BLOCK", *TOP) and self.at.token.kind is not Kind.END:
                    self.declare.recovering(lambda: self.assignment(assignments))
            self.at.expect_word("END_DATA_BLOCK")
        faults = (*found.errors, *found.warnings)
        return BlockDeclaration(name, number, header.optimized, body, constants, tuple(assignments), position, faults)

    def type_declaration(self) -> TypeDeclaration:
        position = self.at.position
        name, _ = self.block_name("the type's name")
        body = Struct((), position)
        with self.collecting() as found:
            header = self.header()
            if header.protected and self.at.token.is_word("END_TYPE"):
                raise SyntaxFault(position.error(_PROTECTED.format(name)))
            if not self.at.token.is_word("STRUCT"):
                raise self.at.expected("STRUCT")
            body, _ = self.declare.sections()
            if not body.members and not found.errors:
                found.add(position.error(f"expected at least one member in the type {name!r}"))
            self.at.accept(";")
            self.at.expect_word("END_TYPE")
        return TypeDeclaration(name, body, position, faults=(*found.errors, *found.warnings))

    def function_block(self) -> TypeDeclaration:
        """Read the interface; the code is passed over."""
        position = self.at.position
        name, _ = self.block_name("the function block's name")
        body, header = Struct((), position), _Header()
        constants: tuple[ConstantDeclaration, ...] = ()
        self.declare.interface = True
        with self.collecting(resume=False) as found:
            header = self.header()
            if header.protected and self.at.token.is_word("BEGIN", "END_FUNCTION_BLOCK"):
                raise SyntaxFault(position.error(_PROTECTED.format(name)))
            body, constants = self.declare.sections()
            if self.at.token.kind is Kind.PUNCT and self.at.token.text not in "#;":  # no statement begins so
                raise self.at.expected("a section of variables or BEGIN")
        self.declare.interface = False
        if not self.at.skip_to("END_FUNCTION_BLOCK"):
            raise SyntaxFault(position.error(f"the function block {name!r} has no END_FUNCTION_BLOCK"))
        self.at.advance()
        return TypeDeclaration(name, body, position, constants, True, header.optimized, tuple(found.errors))

    def code_block(self) -> None:
        start = self.at.advance()
        end, name = f"END_{start.text.upper()}", self.at.token.text
        if not self.at.skip_to(end):
            raise self.at.fault(start, f"{start.text} has no {end}")
        self.at.advance()
        self.at.report.add(self.at.at(start).warning(f"{start.text} {name!r} declares no data block and is skipped"))

    def block_name(self, what: str) -> tuple[str, bool]:
        token = self.at.token
        if token.kind not in (Kind.WORD, Kind.QUOTED):
            raise self.at.expected(what)
        self.at.advance()
        name = token.text
        if token.is_word(*_NUMBERED) and self.at.token.kind is Kind.NUMBER:
            name += self.at.advance().text  # DB 10 is DB10
        return name, token.kind is Kind.QUOTED

    def header(self, header: _Header | None = None) -> _Header:
        """Skip what stands between a block's name and its body; add to what was found before."""
        header = header or _Header()
        while True:
            if self.at.token.is_punct("{"):
                header.optimized |= self.declare.attributes().get("S7_OPTIMIZED_ACCESS", "").upper() == "TRUE"
            elif self.at.token.is_word(*_HEADER):
                word = self.at.advance()
                header.protected |= word.is_word("KNOW_HOW_PROTECT")
                if self.at.accept(":") or self.at.accept("="):
                    while self.at.token.line == word.line and not self.at.token.is_word("STRUCT", "BEGIN", *SECTIONS):
                        if self.at.advance().kind is Kind.END:
                            break
            else:
                return header

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
                index = [integer(self.at, "an index")]
                while self.at.accept(","):
                    index.append(integer(self.at, "an index"))
                self.at.expect("]", "']' after the index")
                target.append(tuple(index))
            if not self.at.accept("."):
                break
        self.at.expect(":=", "':=' and a value")
        value = self.at.value()
        self.at.expect(";", "';' after the value")
        assignments.append(Assignment(tuple(target), value, position))
