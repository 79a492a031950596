"""Import XML that TIA Portal Openness exports (SimaticML): PLC tag tables and data blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

from shmio.errors import Diagnostic, LayoutError, ValueRangeError
from shmio.layout.compiler import Parsed, Program, Source, is_of_access
from shmio.layout.importing import xml_tree
from shmio.layout.importing.found import Found, ImportingError, of_s7
from shmio.layout.importing.plc_tag import CONSTANT, add_plc_tag
from shmio.layout.importing.simatic_declarations import attribute, comment_of, unit_of
from shmio.layout.importing.xml_tree import Node
from shmio.layout.model import Layout, Register
from shmio.layout.place import is_of_left_out
from shmio.layout.s7.notation import in_block
from shmio.layout.source.file import decode
from shmio.layout.tags import TEXTS
from shmio.layout.topic import decode_segment
from shmio.layout.values.literal import default_text, parse_literal, scalar_literal, split_array

ROOT: Final = "Document"
_BLOCKS: Final = ("SW.Blocks.GlobalDB", "SW.Blocks.InstanceDB")
_TABLES: Final = ("SW.Tags.PlcTagTable", "SW.ControllerTagTable")
_TAGS: Final = ("SW.Tags.PlcTag", "SW.ControllerTag")
"""Tables and their tags; the second name is that of TIA Portal V13."""
_REMEDY: Final = (
    "declare the type as a PLC data type in a further file, or leave out all addresses by --by-name to read the block "
    "by OPC UA"
)
_IN_SYSTEM_TYPE: Final = f"its address is unknown, because it is in a system type; {_REMEDY}"
_AFTER_SYSTEM_TYPE: Final = (
    f"its address is unknown, because it is in a system type of unknown size, or after one; {_REMEDY}; for what is "
    "after it, its size by --type-bytes is enough"
)
_MAX_INITIAL: Final = 1000
"""Maximum number of elements of an array whose initial values are imported."""


def read(
    root: Node,
    name: str,
    further: Sequence[Source],
    encoding: str,
    type_bytes: Mapping[str, int],
    *,
    by_name: bool = False,
) -> Found:
    """Return the tags of all tag tables and data blocks; raise ImportingError if there are none.

    Args:
        root: The document.
        name: Name of its file, for messages.
        further: Sources, and other documents, with types, function blocks and constants.
        encoding: Encoding of sources without byte order mark; "": unknown.
        type_bytes: Sizes in bytes of types whose members are unknown, by name.
        by_name: True to leave out the addresses of data blocks.

    """
    found = Found("XML of TIA Portal Openness")
    roots = {name: root}
    sources: list[Source | Parsed] = []
    for source in further:
        if decode(source.text[:4096], encoding).text.lstrip("\ufeff \r\n").startswith("<"):
            try:
                roots[source.file] = xml_tree.parse(source.text)
            except ImportingError as error:
                raise ImportingError(f"{source.file}: {error}") from None
        else:
            sources.append(Source(source.file, source.text, source.encoding or encoding))
    blocks = [(file, node) for file, one in roots.items() for tag in _BLOCKS for node in one.iter(tag)]
    tables = [node for node in root.iter() if node.tag in _TABLES]
    for node in root.iter("SW.Blocks.ArrayDB"):
        found.skip(attribute(node, "Name"), "an ARRAY data block is not supported", node.line)
    if not tables and not blocks:
        others = ", ".join(sorted({child.tag for child in root if child.tag.startswith("SW.")})) or "nothing"
        raise ImportingError(f"expected a PLC tag table or a data block, found {others}")
    for table in tables:
        for node in table.iter():
            if node.tag in _TAGS:
                tag, kind, address = (attribute(node, one) for one in ("Name", "DataTypeName", "LogicalAddress"))
                kind = kind or (node.findtext("LinkList/DataType/Name") or "").strip()
                writable = attribute(node, "ExternalWritable").lower() == "true"
                add_plc_tag(found, tag, kind, address, node.line, comment=comment_of(node), writable=writable)
            elif node.tag == "SW.Tags.PlcUserConstant":
                found.skip(attribute(node, "Name"), CONSTANT, node.line)
    if blocks:
        named, placed = (
            Program([*(Parsed(file, unit_of(file, one, by_name=way)) for file, one in roots.items()), *sources])
            for way in (True, False)
        )
        _add_blocks(
            found, blocks, named, None if by_name else placed, type_bytes, single=len(blocks) == 1 and not tables
        )
    return found


def _add_blocks(
    found: Found,
    blocks: Sequence[tuple[str, Node]],
    named: Program,
    placed: Program | None,
    type_bytes: Mapping[str, int],
    *,
    single: bool,
) -> None:
    """Add the members of data blocks.

    Args:
        found: Where to add them.
        blocks: The blocks and their files.
        named: The program that places members without regard to addresses.
        placed: The program that places members at their addresses; None to leave them out.
        type_bytes: Sizes in bytes of types whose members are unknown, by name.
        single: Whether there is nothing but one block, so that paths need not begin with its name.

    """
    unused = set(type_bytes)
    for _, node in blocks:
        name = attribute(node, "Name")
        try:
            compiled = named.compile((name,), type_bytes, by_name=True)
            [layout] = compiled.layouts
            warnings = [*compiled.warnings]
            unused &= {*compiled.unused}
            addresses: Mapping[str, Register] = {}
            if placed is not None and not layout.optimized:
                addresses, more = _placed(placed, name, type_bytes)
                places = {(one.file, one.line) for one in more}
                # The report itself says which members lack only an address, and whether they are left out.
                warnings = [one for one in warnings if is_of_left_out(one) or (one.file, one.line) not in places]
                warnings += (one for one in more if not is_of_left_out(one))
        except LayoutError as error:
            faults = error.diagnostics or (str(error),)
            found.skip(name, f"the data block cannot be placed: {faults[0]}")  # which has the line
            continue
        shown = [str(one) for one in warnings if not is_of_access(one)]
        found.remarks += [text for text in dict.fromkeys(shown) if text not in found.remarks]
        if single:
            found.block = name
        if not layout.optimized and placed is not None and (layout.number is None or not addresses):
            why = "has no number" if layout.number is None else "has no member whose address is known"
            found.remarks.append(f'{name} {why}: the column is empty; read the block by OPC UA with nodes = "siemens"')
        _add_block(found, layout, addresses, () if single else (name,), node.line)
    found.remarks += [f"--type-bytes: no member has the type {name!r}" for name in sorted(unused)]


def _placed(
    program: Program, name: str, type_bytes: Mapping[str, int]
) -> tuple[Mapping[str, Register], list[Diagnostic]]:
    """Return the registers of a block whose addresses are known, by path, and warnings."""
    try:
        compiled = program.compile((name,), type_bytes)
    except LayoutError as error:
        return {}, [msgspec.structs.replace(one, severity="warning") for one in error.diagnostics]
    return {one.path: one for one in compiled.layouts[0].registers}, [*compiled.warnings]


def _add_block(
    found: Found, layout: Layout, addresses: Mapping[str, Register], prefix: tuple[str, ...], line: int
) -> None:
    name, number = layout.name, layout.number
    if layout.optimized:
        found.remarks.append(
            f"{name} has optimized access: its values have no addresses, and the column is empty; read it by OPC UA "
            "with nodes = \"siemens\", or switch off 'Optimized block access'"
        )
    opaque = tuple(f"{path.removesuffix('bytes')}" for path in addresses if path not in layout.by_path)
    addresses = {path: at for path, at in addresses.items() if number is not None and path in layout.by_path}
    for register in layout.registers:
        at = addresses.get(register.path)
        names = prefix + tuple(map(decode_segment, register.path.split("/")))
        if at is None and addresses:
            inside = register.path.startswith(opaque)
            found.skip("/".join(names), _IN_SYSTEM_TYPE if inside else _AFTER_SYSTEM_TYPE, line)
            continue
        address = ""
        if at is not None and number is not None:
            address = in_block(number, at.offset, at.bit, at.element.size)
        columns = {"address": address, "comment": register.comment, "initial": _initial(found, register)}
        found.add(names, _type(register), columns, line, of_s7 if address else None)


def _type(register: Register) -> str:
    bounds = ", ".join(f"{low}..{high}" for low, high in register.dims)
    return f"ARRAY[{bounds}] OF {register.type}" if bounds else register.type


def _initial(found: Found, register: Register) -> object:
    """Return an initial value as a tag table has it; None if there is none, or if it cannot be read."""
    if register.initial is None:
        return None
    try:
        value = parse_literal(register.initial, register)
    except ValueRangeError as error:
        found.remarks.append(f"{register.path}: the initial value is left out: {error}")
        return None
    is_text = register.element.base in TEXTS
    if not register.dims:
        return value if is_text else register.initial
    if register.count > _MAX_INITIAL:
        found.remarks.append(f"{register.path}: the initial value is left out, because the array is large")
        return None
    items = [default_text(register.element)] * register.count
    for start, count, item in split_array(register.initial, register.shape):
        items[start : start + count] = [item] * count
    return [scalar_literal(item, register.element) if is_text else item for item in items]
