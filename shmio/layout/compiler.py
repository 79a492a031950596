"""Data-block sources to layouts: read, parse, place, emit.

No I/O: the caller reads the files. Sources are those TIA Portal exports (``.db``, ``.udt``, ``.scl``) and those of
STEP 7 classic (``.awl``), given together when one uses types, function blocks or constants of another.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, TypeVar

from shmio.layout import emit, lexer, parser, tags
from shmio.layout.constants import Constants
from shmio.layout.encoding import decode
from shmio.layout.model import MAX_BLOCK_BYTES, MAX_STANDARD_BYTES, Diagnostic, Layout
from shmio.layout.place import MAX_TEXT, Placer
from shmio.layout.placed import Group
from shmio.layout.report import Report, TooManyErrors
from shmio.layout.syntax import Array, BlockDeclaration, ConstantDeclaration, Named, Struct, TypeDeclaration, Unit

_Declaration = TypeVar("_Declaration", TypeDeclaration, BlockDeclaration, ConstantDeclaration)

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
    """Compile the data blocks of one or several files that may use each other's types, or a tag table (``.toml``).

    Raises LayoutError: ``diagnostics`` has everything found, errors first.
    """
    report = Report([source.file for source in sources])
    for source in sources:
        if source.file.endswith(tags.SUFFIX):
            if len(sources) == 1:
                return Compiled((tags.compile_tags(source.file, source.text, report),), tuple(report.warnings))
            report.add(Diagnostic(source.file, 1, 1, "a tag table stands alone, not together with other files"))
            report.raise_errors()
    layouts: list[Layout] = []
    with suppress(TooManyErrors):
        units = [_read(source, report) for source in sources]
        types = _by_name([declaration for unit in units for declaration in unit.types], report)
        given = _by_name([declaration for unit in units for declaration in unit.constants], report)
        constants = Constants(given.values())
        placer = Placer(types, constants, report)
        for declaration in types.values():
            if not declaration.is_function_block:
                placer.named(Named(declaration.name, True, declaration.position))
        blocks = [declaration for unit in units for declaration in unit.blocks]
        if not blocks and not report.errors:
            file = sources[0].file if sources else "<none>"
            report.add(Diagnostic(file, 1, 1, "expected a DATA_BLOCK, found none"))
        _by_name(blocks, report)
        for block in blocks:
            optimized = block.optimized
            if isinstance(block.body, Named) and (instance_of := types.get(block.body.name.lower())):
                optimized |= instance_of.optimized
            layout = _layout(block, optimized, Constants(block.constants, constants), placer, report)
            if layout is not None:
                layouts.append(layout)
    report.raise_errors()
    return Compiled(tuple(layouts), tuple(report.warnings))


def _read(source: Source, report: Report) -> Unit:
    if len(source.text) > lexer.MAX_SOURCE_BYTES:
        report.add(Diagnostic(source.file, 1, 1, f"the file is larger than {lexer.MAX_SOURCE_BYTES} bytes"))
        return Unit()
    decoded = decode(source.text)
    if decoded.problem:
        severity: Literal["error", "warning"] = "error" if decoded.fatal else "warning"
        report.add(Diagnostic(source.file, decoded.line, decoded.column, decoded.problem, severity))
    if decoded.fatal:
        return Unit()
    return parser.parse(source.file, decoded.text, lexer.tokenize(decoded.text), report)


def _by_name(declarations: Sequence[_Declaration], report: Report) -> dict[str, _Declaration]:
    found: dict[str, _Declaration] = {}
    for declaration in declarations:
        first = found.setdefault(declaration.name.lower(), declaration)
        if first is not declaration:
            where = f"{first.position.file}:{first.position.line}"
            report.add(declaration.position.error(f"{declaration.name!r} is declared already, in {where}"))
    return found


def _layout(
    block: BlockDeclaration, optimized: bool, constants: Constants, placer: Placer, report: Report
) -> Layout | None:
    group = _body(block, constants, placer, report)
    if group is None:
        return None
    limit = MAX_BLOCK_BYTES if optimized else MAX_STANDARD_BYTES
    if group.size > limit:
        report.add(block.position.error(f"expected at most {limit} bytes, found a block of {group.size}"))
        return None
    registers, characters = [], 0
    for register in emit.registers(group, report):
        registers.append(register)
        characters += len(register.path) + len(register.comment) + len(register.initial or "")
        if characters > MAX_TEXT:
            what = f"expected at most {MAX_TEXT} characters of names, comments and values"
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
    what = f"expected STRUCT, VAR or the name of a PLC data type or function block, found {body.name}"
    report.add(body.position.error(what))
    return None
