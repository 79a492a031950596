"""Import XML that TIA Portal Openness exports (SimaticML): PLC tag tables and global data blocks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final
from xml.etree.ElementTree import Element

from shmio.errors import LayoutError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.importing.s7_address import in_block, value_type
from shmio.layout.model import Register
from shmio.layout.topic import decode_segment

ROOT: Final = "Document"
_TYPE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(?:\[[0-9]{1,5}\])?")
_ARRAY: Final = re.compile(r"Array\[([-0-9., ]+)\] of (.+)", re.IGNORECASE)


def read(root: Element) -> Found:
    """Return the tags of all tag tables and global data blocks; raise ImportingError if there are none."""
    found = Found("XML of TIA Portal Openness")
    tables, blocks = list(root.iter("SW.Tags.PlcTagTable")), list(root.iter("SW.Blocks.GlobalDB"))
    if not tables and not blocks:
        others = ", ".join(sorted({child.tag for child in root if child.tag.startswith("SW.")})) or "nothing"
        raise ImportingError(f"expected a PLC tag table or a global data block, found {others}")
    for table in tables:
        for tag in table.iter("SW.Tags.PlcTag"):
            _add_tag(found, tag)
        for constant in table.iter("SW.Tags.PlcUserConstant"):
            found.skip(_attribute(constant, "Name"), "a constant has no value in the controller")
    for block in blocks:
        _add_block(found, block, (_attribute(block, "Name"),) if tables or len(blocks) > 1 else ())
    return found


def _attribute(element: Element, name: str) -> str:
    return (element.findtext(f"AttributeList/{name}") or "").strip()


def _add_tag(found: Found, tag: Element) -> None:
    name, kind, address = (_attribute(tag, one) for one in ("Name", "DataTypeName", "LogicalAddress"))
    texts = (text.text or "" for text in tag.iterfind("ObjectList/MultilingualText[@CompositionName='Comment']//Text"))
    if not address:
        found.skip(name, "the tag has no address")
    elif kind.startswith('"'):
        found.skip(name, "a PLC data type; name its members in the table")
    else:
        writable = _attribute(tag, "ExternalWritable").lower() == "true"
        comment = next((text for text in texts if text.strip()), "")
        found.add((name,), value_type(kind), address=address, comment=comment, writable=writable)


def _add_block(found: Found, block: Element, prefix: tuple[str, ...]) -> None:
    """Add the registers of a block, by compiling source text that declares its members."""
    name, number = _attribute(block, "Name"), _attribute(block, "Number")
    section = block.find("AttributeList/Interface/Sections/Section[@Name='Static']")
    if section is None:
        return found.skip(name, "the data block has no members")
    lines = ["DATA_BLOCK DB1", "{ S7_Optimized_Access := 'FALSE' }", "STRUCT"]
    lines += _members(found, section, prefix or (name,), 0)
    lines += ["END_STRUCT;", "BEGIN", "END_DATA_BLOCK"]
    try:
        [layout] = compile_sources([Source(name, "\n".join(lines).encode())]).layouts
    except LayoutError as error:
        return found.skip(name, f"the data block cannot be placed: {error.diagnostics[0].message}")
    standard = _attribute(block, "MemoryLayout") == "Standard"
    if not standard:
        found.remarks.append(
            f"{name} has optimized access: its values have no addresses, and the column is empty; "
            "read it by OPC UA, or switch off 'Optimized block access'"
        )
    for register in layout.registers:
        address = ""
        if standard and number.isdecimal() and len(number) <= 5:
            address = in_block(int(number), register.offset, register.bit, register.element.size)
        names = tuple(prefix) + tuple(_decoded(register))
        found.add(names, _type(register), address=address, comment=register.comment, initial=register.initial)
    return None


def _decoded(register: Register) -> Iterator[str]:
    yield from (decode_segment(segment) for segment in register.path.split("/"))


def _type(register: Register) -> str:
    bounds = ", ".join(f"{low}..{high}" for low, high in register.dims)
    return f"ARRAY[{bounds}] OF {register.type}" if bounds else register.type


def _members(found: Found, section: Element, path: tuple[str, ...], depth: int) -> Iterator[str]:
    """Yield the lines that declare the members of a section or a structure."""
    for member in section.iterfind("Member"):
        name, kind = member.get("Name", ""), member.get("Datatype", "")
        here = (*path, name)
        if not name or '"' in name or not name.isprintable():
            raise ImportingError(
                f"{'/'.join(path)}: the member name {name!r} is not allowed in source text; rename the member"
            )
        array = _ARRAY.fullmatch(kind)
        bounds, element = (f"ARRAY[{array[1]}] OF ", array[2]) if array else ("", kind)
        inner = member if element.lower() == "struct" else member.find("Sections/Section[@Name='None']")
        comment = " ".join((member.findtext("Comment/MultiLanguageText") or "").split())
        tail = f"  // {comment}" if comment else ""
        if (inner is not None and (element.lower() == "struct" or element.startswith('"'))) or (
            inner is not None and not array and inner.find("Member") is not None
        ):
            yield f'"{name}" : {bounds}STRUCT{tail}'
            yield from _members(found, inner, here, depth + 1)
            yield "END_STRUCT;"
            continue
        if not _TYPE.fullmatch(element):
            raise ImportingError(f"{'/'.join(here)}: the members of the type {kind} are not in the file")
        start = " ".join((member.findtext("StartValue") or "").split())
        given = f" := {start}" if start and not array and _is_plain(start) else ""
        yield f'"{name}" : {bounds}{element}{given};{tail}'


def _is_plain(start: str) -> bool:
    """Return whether a start value is a literal and not the name of a constant."""
    return (bool(re.fullmatch(r"'[^'$;]*'|[-+0-9A-Za-z#_.:]+", start)) and not start[0].isalpha()) or bool(
        re.fullmatch(r"true|false|[A-Za-z0-9_]+#[-+0-9A-Za-z_.:#]+", start, re.IGNORECASE)
    )
