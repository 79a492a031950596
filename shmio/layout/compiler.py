"""Compile the sources of data blocks to layouts, in the steps decode, parse, place and emit.

No I/O: the caller reads the files. Sources are exports of TIA Portal (``.db``, ``.udt``, ``.scl``) and
of STEP 7 classic (``.awl``). Files that use each other's types, function blocks or constants must be
compiled together.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import msgspec

from shmio.errors import Diagnostic
from shmio.layout import emit, tags
from shmio.layout.foreign import foreign, misplaced_list
from shmio.layout.model import MAX_BLOCK_BYTES, MAX_STANDARD_BYTES, Layout
from shmio.layout.overlay_table import OverlayTable, lay_tables
from shmio.layout.place import MAX_TEXT, Cost, Group, Placer, Unknown
from shmio.layout.report import Report, TooManyErrors
from shmio.layout.source import lexer, parser
from shmio.layout.source.constants import Constants
from shmio.layout.source.file import EASTERN, decode
from shmio.layout.source.syntax import (
    Array,
    BlockDeclaration,
    ConstantDeclaration,
    Named,
    Struct,
    TypeDeclaration,
    Unit,
)
from shmio.wording import larger_than

SUFFIXES = (".db", ".udt", ".scl", ".awl", ".s7dcl")
"""Suffixes of sources of data blocks."""
MAX_ALL_REGISTERS = 500_000
MAX_ALL_STRUCTURES = 500_000
"""Maximum number of structures in all blocks compiled together: a small source can declare many large blocks."""

_Declaration = TypeVar("_Declaration", TypeDeclaration, BlockDeclaration, ConstantDeclaration)

_OPTIMIZED = (
    "the block {name} has optimized access: its values have no fixed addresses and the classic S7 protocol cannot "
    "read them; switch off 'Optimized block access' in the block's properties, and compile and load the block; or read "
    'it by OPC UA: connector = "opcua" with nodes = "siemens". Offsets have no meaning in such a block'
)
_MARK = " has optimized access: "


@dataclass(frozen=True)
class Source:
    """One source file: its name, for diagnostics, and its content."""

    file: str
    text: bytes
    encoding: str = ""
    """Encoding of a text without byte order mark, one of :data:`shmio.layout.encodings.NAMES`; "" if unknown."""


@dataclass(frozen=True)
class Parsed:
    """The declarations of a file in another format, which an importer has read."""

    file: str
    unit: Unit


@dataclass(frozen=True)
class Compiled:
    """Result of a compilation: the layouts in source order, and the warnings.

    ``unused`` are the types whose size the caller gave although no member has such a type.
    """

    layouts: tuple[Layout, ...]
    warnings: tuple[Diagnostic, ...]
    unused: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BlockName:
    """Name and number of a data block that the sources declare."""

    name: str
    number: int | None


def compile_sources(
    sources: Sequence[Source], *, blocks: Collection[str] | None = None, type_bytes: Mapping[str, int] | None = None
) -> Compiled:
    """Compile the data blocks of files that may use each other's types, or compile one tag table.

    If the files include the source of a data block, all tag tables among them lie over the block.

    Args:
        sources: The files.
        blocks: Names of the data blocks to compile, in upper or lower case. Errors in other blocks
            are ignored. None compiles all blocks.
        type_bytes: Sizes in bytes of types whose members are unknown, by type name in upper or
            lower case.

    Returns:
        The layouts in source order, with the warnings.

    Raises:
        LayoutError: A source is wrong; ``diagnostics`` has all errors, then all warnings.

    """
    return Program(sources).compile(blocks, type_bytes)


class Program:
    """Parsed sources, whose data blocks you can compile together or one at a time."""

    def __init__(self, sources: Sequence[Source | Parsed]) -> None:
        """Parse the sources.

        Raises:
            LayoutError: A tag table is invalid, or there are several tag tables and nothing else.

        """
        self._files = [source.file for source in sources]
        self._general = Report(self._files)
        self._table: Layout | None = None
        self._overlays: list[OverlayTable] = []
        self._units: list[Unit] = []
        self._types: dict[str, TypeDeclaration] = {}
        self._constants: dict[str, ConstantDeclaration] = {}
        self._doubles: list[Diagnostic] = []
        self.blocks: tuple[BlockName, ...] = ()
        with suppress(TooManyErrors):
            self._read(sources)

    @property
    def is_table(self) -> bool:
        """True if the sources are a tag table, False if they declare data blocks."""
        return self._table is not None

    def _read(self, files: Sequence[Source | Parsed]) -> None:
        report = self._general
        self._units = [file.unit for file in files if isinstance(file, Parsed)]
        sources = [file for file in files if isinstance(file, Source)]
        tables = [source for source in sources if source.file.lower().endswith(tags.SUFFIXES)]
        for table in tables:
            if what := misplaced_list(table.file, table.text):
                report.add(Diagnostic(table.file, 1, 1, what))
        if tables:
            report.raise_errors()
        if tables and len(tables) == len(sources):
            if len(tables) > 1:
                what = (
                    "there are several tag tables without a data block; give only one of them, or add the "
                    "block's source"
                )
                report.add(Diagnostic(tables[1].file, 1, 1, what))
                report.raise_errors()
            self._table = tags.compile_tags(tables[0].file, tables[0].text, report, tables[0].encoding)
            self.blocks = (BlockName(self._table.name, None),)
            return
        self._overlays = [OverlayTable(table.file, table.text, table.encoding) for table in tables]
        sources = [source for source in sources if source not in tables]
        for source in sources:
            self._units.append(_read(source, report))
        types, doubles = self._by_name([declaration for unit in self._units for declaration in unit.types])
        self._types = types | {
            key: replace(types[key], faults=(*types[key].faults, fault)) for key, fault in doubles.items()
        }
        self._constants, _ = self._by_name([declaration for unit in self._units for declaration in unit.constants])
        blocks = [declaration for unit in self._units for declaration in unit.blocks]
        self._by_name(blocks)
        self.blocks = tuple(BlockName(block.name, block.number) for block in blocks)
        if not blocks and not report.errors and not any(fault.severity == "error" for fault in self._faults()):
            file = files[0].file if files else "<none>"
            report.add(Diagnostic(file, 1, 1, "the files have no DATA_BLOCK"))

    def _by_name(self, declarations: Sequence[_Declaration]) -> tuple[dict[str, _Declaration], dict[str, Diagnostic]]:
        """Index declarations by name in lower case; also return an error for each duplicate."""
        found: dict[str, _Declaration] = {}
        doubles: dict[str, Diagnostic] = {}
        for declaration in declarations:
            key = declaration.name.lower()
            first = found.setdefault(key, declaration)
            if first is not declaration and key not in doubles:
                doubles[key] = _double(first, declaration)
        self._doubles += doubles.values()
        return found, doubles

    def _faults(self) -> Iterator[Diagnostic]:
        """Yield the errors and warnings of all declarations except function blocks.

        A function block's faults are reported only where it is used.
        """
        for unit in self._units:
            declarations: list[TypeDeclaration | BlockDeclaration] = [*unit.types, *unit.blocks]
            for declaration in sorted(declarations, key=lambda one: (one.position.line, one.position.column)):
                if not (isinstance(declaration, TypeDeclaration) and declaration.is_function_block):
                    yield from declaration.faults
        yield from self._doubles

    def compile(
        self,
        blocks: Collection[str] | None = None,
        type_bytes: Mapping[str, int] | None = None,
        *,
        by_name: bool = False,
    ) -> Compiled:
        """Compile the data blocks named in ``blocks`` (None: all). :func:`compile_sources` explains the arguments.

        With ``by_name``, the members will be read by their names: no type needs a size, and the places of
        the members have no meaning. This is always so for blocks with optimized access.

        Raises:
            LayoutError: A source is wrong; ``diagnostics`` has all errors, then all warnings.

        """
        if self._table is not None:
            return Compiled((self._table,), tuple(self._general.warnings))
        report = Report(self._files)
        layouts: list[Layout] = []
        with suppress(TooManyErrors):
            report.extend((*self._general.errors, *self._general.warnings))
            constants = Constants(self._constants.values())
            placers = [Placer(self._types, constants, report, type_bytes, by_name=named) for named in (False, True)]
            wanted = [block for unit in self._units for block in unit.blocks]
            if blocks is None:
                report.extend(self._faults())
                all_named = by_name or all(map(self._is_optimized, wanted))
                for declaration in self._types.values():
                    if declaration.body.members and not declaration.is_function_block:
                        placers[all_named].named(Named(declaration.name, True, declaration.position))
            else:
                names = {name.lower() for name in blocks}
                wanted = [block for block in wanted if block.name.lower() in names]
                self._report_chosen(wanted, report)
            spent = Cost()
            for block in wanted:
                own = Constants(block.constants, constants)
                named = by_name or self._is_optimized(block)
                group = _body(block, own, placers[named], report)
                if group is None:
                    continue
                if group.open and not group.cost.registers:
                    report.add(msgspec.structs.replace(group.open.why, severity="error"))
                    continue
                spent = spent.plus(group.cost, 1, 0)
                if spent.registers > MAX_ALL_REGISTERS or spent.structures > MAX_ALL_STRUCTURES:
                    what = (
                        f"the data blocks up to this one have more than {MAX_ALL_REGISTERS} registers or "
                        f"{MAX_ALL_STRUCTURES} structures; choose one data block"
                    )
                    report.add(block.position.error(what))
                    break
                layout = _layout(block, group, self._is_optimized(block), own, report)
                if layout is not None:
                    layouts.append(layout)
            if not report.errors:
                held = [block.name for block in self.blocks]
                layouts = lay_tables(self._overlays, layouts, held, report, chosen=blocks is not None)
        report.raise_errors()
        used = {key for placer in placers for key in placer.placed}
        unused = tuple(name for name in type_bytes or () if name.lower() not in used)
        return Compiled(tuple(layouts), tuple(report.warnings), unused)

    def _report_chosen(self, wanted: Sequence[BlockDeclaration], report: Report) -> None:
        """Report the faults of these blocks only."""
        names: dict[str, BlockDeclaration] = {}
        for block in wanted:
            report.extend(block.faults)
            first = names.setdefault(block.name.lower(), block)
            if first is not block:
                report.add(_double(first, block))

    def _is_optimized(self, block: BlockDeclaration) -> bool:
        instance_of = self._types.get(block.body.name.lower()) if isinstance(block.body, Named) else None
        return block.optimized or (instance_of is not None and instance_of.optimized)


def is_of_access(warning: Diagnostic) -> bool:
    """Return whether a warning says that a block has optimized access."""
    return _MARK in warning.message


def _double(first: _Declaration, second: _Declaration) -> Diagnostic:
    where = f"{first.position.file}:{first.position.line}"
    return second.position.error(f"{second.name!r} is declared twice, first in {where}")


def _read(source: Source, report: Report) -> Unit:
    if len(source.text) > lexer.MAX_SOURCE_BYTES:
        report.add(Diagnostic(source.file, 1, 1, larger_than(lexer.MAX_SOURCE_BYTES)))
        return Unit()
    if what := foreign(source.file, source.text):
        report.add(Diagnostic(source.file, 1, 1, what))
        return Unit()
    decoded = decode(source.text, source.encoding)
    if decoded.eastern:
        report.add(Diagnostic(source.file, decoded.line, decoded.column, EASTERN))
        return Unit()
    if decoded.problem:
        severity: Literal["error", "warning"] = "error" if decoded.fatal else "warning"
        report.add(Diagnostic(source.file, decoded.line, decoded.column, decoded.problem, severity))
    if decoded.fatal:
        return Unit()
    return parser.parse(source.file, decoded.text, lexer.tokenize(decoded.text), report)


def _layout(
    block: BlockDeclaration, group: Group, optimized: bool, constants: Constants, report: Report
) -> Layout | None:
    limit = MAX_BLOCK_BYTES if optimized else MAX_STANDARD_BYTES
    if group.size > limit:
        report.add(block.position.error(f"the data block has {group.size} bytes, but at most {limit} are allowed"))
        return None
    registers, characters = [], 0
    for register in emit.registers(group, report):
        registers.append(register)
        characters += len(register.path) + len(register.comment) + len(register.initial or "")
        if characters > MAX_TEXT:
            what = f"the names, comments and values have more than {MAX_TEXT} characters together"
            report.add(block.position.error(what))
            return None
    assigned = emit.assign(group, registers, block.assignments, constants, report)
    if optimized:
        report.add(block.position.warning(_OPTIMIZED.format(name=block.name)))
    return Layout(block.name, block.number, group.size, optimized, assigned)


def _body(block: BlockDeclaration, constants: Constants, placer: Placer, report: Report) -> Group | None:
    body = block.body
    if isinstance(body, Struct):
        return placer.block(body, constants)
    if isinstance(body, Array):
        what = "expected STRUCT, VAR or the name of a type; ARRAY data blocks are not supported"
        report.add(body.position.error(what))
        return None
    found = placer.named(body)
    if found is None or isinstance(found, Group):
        return found
    if isinstance(found, Unknown):
        report.add(msgspec.structs.replace(found.why, severity="error"))
        return None
    what = f"expected STRUCT, VAR or the name of a PLC data type or function block, found {body.name}"
    report.add(body.position.error(what))
    return None
