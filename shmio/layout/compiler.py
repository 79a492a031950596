"""Data-block sources to layouts: read, parse, place, emit.

No I/O: the caller reads the files. Sources are those TIA Portal exports (``.db``, ``.udt``, ``.scl``), given
together when one uses types of another.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

from shmio.layout import emit, lexer, parser
from shmio.layout.model import MAX_BLOCK_BYTES, MAX_STANDARD_BYTES, Diagnostic, Layout
from shmio.layout.place import Group, Placer
from shmio.layout.report import Report, TooManyErrors
from shmio.layout.syntax import Array, BlockDeclaration, Named, Position, Struct, TypeDeclaration, Unit

_Declaration = TypeVar("_Declaration", TypeDeclaration, BlockDeclaration)

_OPTIMIZED = (
    "the block {name} has optimized access: its values have no fixed addresses and the classic S7 protocol cannot "
    "read it; switch off 'Optimized block access' in the block's properties, or use OPC UA. "
    "The offsets are those it would have with standard access"
)


@dataclass(frozen=True)
class Source:
    """A file's name, for diagnostics, and its bytes as read."""

    file: str
    text: bytes


@dataclass(frozen=True)
class Compiled:
    """The layouts of all data blocks, in source order."""

    layouts: tuple[Layout, ...]
    warnings: tuple[Diagnostic, ...]


def compile_sources(sources: Sequence[Source]) -> Compiled:
    """Compile the data blocks of one or several files that may use each other's types.

    Raises LayoutError: ``diagnostics`` has everything found, errors first.
    """
    report = Report([source.file for source in sources])
    layouts: list[Layout] = []
    with suppress(TooManyErrors):
        units = [_read(source, report) for source in sources]
        types = _by_name([declaration for unit in units for declaration in unit.types], report)
        skipped = frozenset(name.lower() for unit in units for name in unit.skipped)
        placer = Placer(types, skipped, report)
        for declaration in types.values():
            placer.named(Named(declaration.name, True, declaration.position))
        blocks = [declaration for unit in units for declaration in unit.blocks]
        if not blocks and not report.errors:
            file = sources[0].file if sources else "<none>"
            report.add(Diagnostic(file, 1, 1, "expected a DATA_BLOCK, found none"))
        _by_name(blocks, report)
        for block in blocks:
            layout = _layout(block, placer, report)
            if layout is not None:
                layouts.append(layout)
    report.raise_errors()
    return Compiled(tuple(layouts), tuple(report.warnings))


def _read(source: Source, report: Report) -> Unit:
    data = source.text.removeprefix(b"\xef\xbb\xbf")
    if len(data) > lexer.MAX_SOURCE_BYTES:
        report.add(Diagnostic(source.file, 1, 1, f"the file is larger than {lexer.MAX_SOURCE_BYTES} bytes"))
        return Unit()
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        before = data[: error.start].decode("utf-8").splitlines() or [""]
        message = "expected UTF-8, found bytes that are not; export the source again, or save it as UTF-8"
        report.add(Diagnostic(source.file, len(before), len(before[-1]) + 1, message))
        return Unit()

    def problem(line: int, column: int, message: str) -> None:
        report.add(Diagnostic(source.file, line, column, message))

    return parser.parse(source.file, text, lexer.tokenize(text, problem), report)


def _by_name(declarations: Sequence[_Declaration], report: Report) -> dict[str, _Declaration]:
    found: dict[str, _Declaration] = {}
    for declaration in declarations:
        first = found.setdefault(declaration.name.lower(), declaration)
        if first is not declaration:
            where = f"{first.position.file}:{first.position.line}"
            report.add(declaration.position.error(f"{declaration.name!r} is declared already, in {where}"))
    return found


def _layout(block: BlockDeclaration, placer: Placer, report: Report) -> Layout | None:
    group = _body(block, placer, report)
    if group is None:
        return None
    limit = MAX_BLOCK_BYTES if block.optimized else MAX_STANDARD_BYTES
    if group.size > limit:
        report.add(block.position.error(f"expected at most {limit} bytes, found a block of {group.size}"))
        return None
    registers = tuple(emit.registers(group))
    if block.assignments:
        registers = emit.assign(group, registers, block.assignments, report)
    if block.optimized:
        report.add(block.position.warning(_OPTIMIZED.format(name=block.name)))
    return Layout(block.name, block.number, group.size, block.optimized, registers)


def _body(block: BlockDeclaration, placer: Placer, report: Report) -> Group | None:
    body = block.body
    if isinstance(body, Struct):
        return placer.struct(body)
    position: Position = body.position
    if isinstance(body, Array):
        report.add(position.error("expected STRUCT, VAR or the name of a type; ARRAY data blocks are not supported"))
        return None
    found = placer.named(body)
    if found is None or isinstance(found, Group):
        return found
    report.add(position.error(f"expected STRUCT, VAR or the name of a PLC data type, found {body.name}"))
    return None
