"""Parse tokens into declarations by recursive descent: files, blocks, assignments after BEGIN.

Sources have one of two forms. In SIMATIC SD (``.s7dcl``, TIA Portal V20 and later), attributes precede
a block, a type's name follows the keyword TYPE, assignments follow the sections without BEGIN, and
``_.`` precedes a name of the whole program.

After a syntax error the parser continues at the next ``;`` or ``END_…``, so that one run finds all
errors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace

from shmio.layout.model import MAX_DEPTH
from shmio.layout.report import MAX_ERRORS, Report, TooManyErrors
from shmio.layout.source.constants import bound, bounds, integer, string_length
from shmio.layout.source.lexer import Cursor, Kind, SyntaxFault, Token, tokenize
from shmio.layout.source.syntax import (
    Array,
    Assignment,
    BlockDeclaration,
    Bound,
    ConstantDeclaration,
    Member,
    Named,
    Position,
    Section,
    Struct,
    Type,
    TypeDeclaration,
    Unit,
)

_TOP = ("DATA_BLOCK", "TYPE", "FUNCTION", "FUNCTION_BLOCK", "ORGANIZATION_BLOCK")
_INTERFACE = {section.value: section for section in Section}
_SECTIONS = (*_INTERFACE, "VAR_RETAIN", "VAR_TEMP", "CONST", "LABEL")
_BLOCK_SECTIONS = ("VAR", "VAR_RETAIN")
_SECTION_WORDS = ("RETAIN", "NON_RETAIN", "DB_SPECIFIC")
_STOPS = ("END_STRUCT", "END_VAR", "END_CONST", "END_TYPE", "END_DATA_BLOCK", "END_FUNCTION_BLOCK", "BEGIN", *_TOP)
_NUMBERED_TYPES = ("UDT", "FB", "SFB")
_HEADER = (
    *("AUTHOR", "FAMILY", "NAME", "VERSION", "CODE_VERSION1", "STANDARD"),
    *("KNOW_HOW_PROTECT", "UNLINKED", "READ_ONLY", "NON_RETAIN", "RETAIN"),
)
_NUMBERED = ("DB", "UDT", "FB", "FC", "OB", "SFB")
_DB_NUMBER = re.compile(r"DB([1-9][0-9]{0,4})", re.IGNORECASE)
_PROTECTED = (
    "{!r} is know-how protected and its declaration is not in the source; remove the protection in its "
    "properties and export it again, or write its members here"
)
SD_SUFFIX = ".s7dcl"
_SPACED = "the name {!r} has spaces and no quotes (as in print, where underscores can be lost); it is kept as written"
_MAX_NUMBER = 65_535
_PLAIN = re.compile(r"\w+")


def parse(file: str, text: str, tokens: list[Token], report: Report) -> Unit:
    """Parse one file. Report errors, and leave wrong declarations out of the result."""
    sd = file.lower().endswith(SD_SUFFIX) or tokens[0].is_punct("{")
    sd = sd or (tokens[0].is_word("TYPE") and len(tokens) > 2 and tokens[2].is_punct(":"))
    return _Parser(Cursor(file, text, tokens, report), sd=sd).unit()


def parse_type(position: Position, text: str, report: Report) -> Type | None:
    """Parse the name of a type, such as ``Array[0..9] of Int``; report an error and return None if it is wrong."""
    at = _cursor(position, text, report)
    try:
        found = _Declarations(at).body_type()
        if not at.at_end():
            raise at.expected("a type")
    except SyntaxFault as fault:
        report.add(fault.diagnostic)
        return None
    return found


def parse_number(position: Position, text: str) -> Bound | None:
    """Parse the value of a constant as a bound; return None if it cannot be one."""
    at = _cursor(position, text, Report([position.file]))
    try:
        found = bound(at, "a number")
    except SyntaxFault:
        return None
    return found if at.at_end() else None


def _cursor(position: Position, text: str, report: Report) -> Cursor:
    """Return a cursor over text that is all at one place of a file."""
    tokens = tokenize(text)
    for token in tokens:
        token.line, token.column = position.line, position.column
    return Cursor(position.file, text, tokens, report)


class _Declarations:
    """Reads the declarations at a cursor.

    ``interface`` is True in a function block, where names have no spaces.
    """

    def __init__(self, cursor: Cursor) -> None:
        self.at = cursor
        self.interface = False

    def sections(self) -> tuple[Struct, tuple[ConstantDeclaration, ...]]:
        """Read a body, which is one STRUCT or several sections; return its members and constants.

        Return the members of a function block in the order in which its instances store them.
        """
        position = self.at.position
        if self.at.accept_word("STRUCT"):
            return Struct(self.members("END_STRUCT", 0), position), ()
        members: list[Member] = []
        constants: list[ConstantDeclaration] = []
        while self.at.token.is_word(*(_SECTIONS if self.interface else _BLOCK_SECTIONS)):
            keyword = self.at.advance().text.upper()
            if keyword in ("VAR_TEMP", "LABEL"):  # an instance does not store them
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
                section = _INTERFACE.get(keyword, Section.STATIC) if self.interface else None
                members += (replace(member, section=section) for member in self.members("END_VAR", 0))
            self.at.accept(";")
        if self.interface:
            order = list(Section)
            members.sort(key=lambda member: order.index(member.section or Section.STATIC))
        return Struct(tuple(members), position), tuple(constants)

    def constants(self, end: str) -> list[ConstantDeclaration]:
        """Read constants up to the end keyword of their section."""
        constants: list[ConstantDeclaration] = []
        while not self.at.accept_word(end):
            if self.stops():
                raise self.at.expected(f"a constant or {end}")
            self.recovering(lambda: self._constant(constants))
        return constants

    def _constant(self, constants: list[ConstantDeclaration]) -> None:
        if self.at.accept(";"):
            return
        if self.at.token.is_punct("{"):
            self.attributes()
        name, position, _ = self._name()
        if self.at.token.is_punct("{"):
            self.attributes()
        if self.at.accept(":"):  # classic SCL gives no type
            self._type(0)
        self.at.expect(":=", "':=' and the constant's value")
        start, number = self.at.index, None
        with suppress(SyntaxFault):  # the constant is not a number
            number = bound(self.at, "a number")
        if not self.at.token.is_punct(";"):
            number = None
        self.at.rewind(start)
        value = self.at.value()
        self.at.expect(";", "';' after the value")
        constants.append(ConstantDeclaration(name, value, number, position))

    def members(self, end: str, depth: int) -> tuple[Member, ...]:
        """Read members up to the end keyword of their structure or section."""
        members: list[Member] = []
        while self.at.names_member() or not self.at.accept_word(end):
            if self.stops():
                raise self.at.expected(f"a member or {end}")
            self.recovering(lambda: self._member(members, depth))
        return tuple(members)

    def stops(self) -> bool:
        """Return whether a list of members ends at the current token although its end keyword is missing."""
        token = self.at.token
        return token.kind is Kind.END or (token.is_word(*_STOPS) and not self.at.names_member())

    def recovering(self, read: Callable[[], None]) -> None:
        """Call ``read``; report a syntax error, and skip to the end of the statement."""
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
        """Read ``{ name := 'value'; … }``; return values without quotes, by name in upper case."""
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

    def _member(self, members: list[Member], depth: int) -> None:
        if self.at.accept(";"):
            return
        if self.at.token.is_punct("{"):  # SIMATIC SD has the attributes first
            self.attributes()
        names = [self._name()]
        while self.at.accept(","):
            names.append(self._name())
        if self.at.token.is_punct("{"):
            self.attributes()
        is_view = self.interface and self.at.accept_word("AT")  # a view of another member: not stored
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
        """Read a name; return the name, its place, and whether it was in quotes."""
        position, token = self.at.position, self.at.token
        if token.kind is Kind.QUOTED:
            return self.at.advance().text, position, True
        if token.kind is not Kind.WORD:
            raise self.at.expected("a member's name")
        return self.at.advance().text if self.interface else self.at.words(), position, False

    def body_type(self) -> Type:
        """Read the name of the type that a data block has instead of a body."""
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
            return Named(self.dotted(), True, position)
        if token.kind is not Kind.WORD or token.is_word(*_STOPS, *_SECTIONS):
            raise self.at.expected("a type")
        self.at.advance()
        if token.is_word("STRING", "WSTRING"):
            return Named(token.text.upper(), False, position, string_length(self.at, token.text.upper()))
        if token.is_word(*_NUMBERED_TYPES) and self.at.token.kind is Kind.NUMBER:
            return Named(token.text + self.at.advance().text, False, position)  # UDT 10 is UDT10
        if self.at.token.is_punct("."):
            return Named(self.dotted(token), True, position)
        return Named(token.text, False, position)

    def dotted(self, first: Token | None = None) -> str:
        """Read a name that may have the name of a software unit before it: ``"Tools"."Axis"``, ``_.Axis``.

        ``first`` is the first name if it has been read already. In the result, a unit precedes a
        point; ``_``, which stands for the program outside of units, is left out.
        """
        parts = [(first or self.at.advance()).text]
        while self.at.accept("."):
            if self.at.token.kind not in (Kind.WORD, Kind.QUOTED):
                raise self.at.expected("a name")
            parts.append(self.at.advance().text)
        return ".".join(parts[1:] if parts[0] == "_" and len(parts) > 1 else parts)


@dataclass(slots=True)
class _Header:
    """The properties that a source gives between a block's name and its body."""

    optimized: bool = False
    protected: bool = False
    number: int | None = None


class _Parser:
    def __init__(self, cursor: Cursor, *, sd: bool) -> None:
        self.at = cursor
        self.declare = _Declarations(cursor)
        self._sd = cursor.attributes_first = sd
        self._before: _Header | None = None  # the attributes before a block

    def attributes_before(self) -> None:
        """Read the attributes that SIMATIC SD has before a block."""
        found = self.declare.attributes()
        number = found.get("S7_BLOCKNUMBER", "")
        self._before = _Header(
            optimized=found.get("S7_OPTIMIZED", "TRUE").upper() == "TRUE",
            number=int(number) if number.isdecimal() and len(number) <= 5 and 0 < int(number) <= _MAX_NUMBER else None,
        )

    def take_before(self) -> _Header:
        """Return the attributes before the current block. A block of SIMATIC SD that has none is optimized."""
        before, self._before = self._before, None
        return before or _Header(optimized=self._sd)

    def unit(self) -> Unit:
        unit = Unit()
        while not self.at.at_end():
            try:
                if self.at.token.is_punct("{"):
                    self.attributes_before()
                elif self.at.accept_word("DATA_BLOCK"):
                    unit.blocks.append(self.block())
                elif self.at.accept_word("TYPE"):
                    unit.types += self.type_declarations()
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
        """Go to the beginning of the next declaration, or of the attributes before it."""
        opening = closing = -1
        while not self.at.at_end() and not self.at.token.is_word(*_TOP):
            if self.at.token.is_punct("{"):
                opening = self.at.index
            elif self.at.token.is_punct("}"):
                closing = self.at.index
            self.at.advance()
        if self._sd and 0 <= opening < closing == self.at.index - 1:
            self.at.rewind(opening)

    @contextmanager
    def collecting(self, *, resume: bool = True) -> Iterator[Report]:
        """Collect the errors of one declaration in their own report: they count only if it is used.

        With ``resume``, skip to the next declaration after a syntax error.
        """
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
            self.at.skip_to_any(*_TOP)
        self.at.report = outer

    def block(self) -> BlockDeclaration:
        position = self.at.position
        name, quoted = self.block_name("the block's name")
        match = None if quoted else _DB_NUMBER.fullmatch(name)
        header = self.take_before()
        number = header.number or (int(match[1]) if match and int(match[1]) <= _MAX_NUMBER else None)
        body: Type = Struct((), position)
        constants: tuple[ConstantDeclaration, ...] = ()
        assignments: list[Assignment] = []
        with self.collecting() as found:
            header = self.header(header)
            if header.protected and self.at.token.is_word("BEGIN", "END_DATA_BLOCK"):
                raise SyntaxFault(position.error(_PROTECTED.format(name)))
            if self._sd and self.at.accept(":"):
                body = self.declare.body_type()
            elif self._sd or self.at.token.is_word("STRUCT", *_BLOCK_SECTIONS):
                body, constants = self.declare.sections()
            else:
                body = self.declare.body_type()
                header = self.header(header)  # STEP 7 allows it before and after the type's name
            self.at.accept(";")
            if self.at.accept_word("BEGIN") or self._sd:
                while not self.at.token.is_word("END_DATA_BLOCK", *_TOP) and self.at.token.kind is not Kind.END:
                    self.declare.recovering(lambda: self.assignment(assignments))
            self.at.expect_word("END_DATA_BLOCK")
        faults = (*found.errors, *found.warnings)
        return BlockDeclaration(name, number, header.optimized, body, constants, tuple(assignments), position, faults)

    def type_declarations(self) -> list[TypeDeclaration]:
        """Read what follows the keyword TYPE: one type, or in SIMATIC SD several, each with a colon after its name."""
        if not self._sd:
            return [self.type_declaration()]
        self.take_before()
        found: list[TypeDeclaration] = []
        while not self.at.accept_word("END_TYPE"):
            if self.at.at_end() or self.at.token.is_word(*_TOP):
                raise self.at.expected("a type or END_TYPE")
            if self.at.token.is_punct("{"):
                self.declare.attributes()
            position = self.at.position
            name, _ = self.block_name("the type's name")
            body = Struct((), position)
            with self.collecting() as report:
                self.at.expect(":", "':' after the type's name")
                if not self.at.token.is_word("STRUCT"):
                    raise self.at.expected("STRUCT")
                body, _ = self.declare.sections()
                self.at.accept(";")
            found.append(TypeDeclaration(name, body, position, faults=(*report.errors, *report.warnings)))
            if report.errors and (self.at.at_end() or self.at.token.is_word(*_TOP)):
                break
        return found

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
                found.add(position.warning(f"the type {name!r} has no members, so nothing can have this type"))
            self.at.accept(";")
            self.at.expect_word("END_TYPE")
        return TypeDeclaration(name, body, position, faults=(*found.errors, *found.warnings))

    def function_block(self) -> TypeDeclaration:
        """Read the interface of a function block; skip its code."""
        position = self.at.position
        name, _ = self.block_name("the function block's name")
        body, header = Struct((), position), self.take_before()
        constants: tuple[ConstantDeclaration, ...] = ()
        self.declare.interface = True
        with self.collecting(resume=False) as found:
            header = self.header(header)
            if header.protected and self.at.token.is_word("BEGIN", "END_FUNCTION_BLOCK"):
                raise SyntaxFault(position.error(_PROTECTED.format(name)))
            body, constants = self.declare.sections()
            if self.at.token.kind is Kind.PUNCT and self.at.token.text not in "#;{":  # no statement begins like this
                raise self.at.expected("a section of variables or BEGIN")
        self.declare.interface = False
        if not self.at.skip_to("END_FUNCTION_BLOCK"):
            raise SyntaxFault(position.error(f"the function block {name!r} has no END_FUNCTION_BLOCK"))
        self.at.advance()
        return TypeDeclaration(name, body, position, constants, True, header.optimized, tuple(found.errors))

    def code_block(self) -> None:
        self.take_before()
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
        name = self.declare.dotted()
        if token.is_word(*_NUMBERED) and self.at.token.kind is Kind.NUMBER:
            name += self.at.advance().text  # DB 10 is DB10
        return name, token.kind is Kind.QUOTED

    def header(self, header: _Header | None = None) -> _Header:
        """Read the lines between a block's name and its body; add their properties to ``header``."""
        header = header or _Header()
        while True:
            if self.at.token.is_punct("{"):
                header.optimized |= self.declare.attributes().get("S7_OPTIMIZED_ACCESS", "").upper() == "TRUE"
            elif self.at.token.is_word(*_HEADER):
                word = self.at.advance()
                header.protected |= word.is_word("KNOW_HOW_PROTECT")
                if self.at.accept(":") or self.at.accept("="):
                    while self.at.token.line == word.line and not self.at.token.is_word("STRUCT", "BEGIN", *_SECTIONS):
                        if self.at.advance().kind is Kind.END:
                            break
            else:
                return header

    def assignment(self, assignments: list[Assignment]) -> None:
        if self.at.accept(";"):
            return
        if self.at.token.is_punct("{"):
            self.declare.attributes()
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
        if value == "()":  # SIMATIC SD: no value of its own
            return
        assignments.append(Assignment(tuple(target), value, position))
