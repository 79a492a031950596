"""Read the declarations of SimaticML: the interfaces of blocks and types, and constants."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from shmio.errors import Diagnostic
from shmio.layout.importing.xml_tree import Node
from shmio.layout.model import MAX_DEPTH, element_type
from shmio.layout.report import Report
from shmio.layout.source import parser, system_types
from shmio.layout.source.syntax import (
    Array,
    Assignment,
    BlockDeclaration,
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

_SECTIONS: Final = {
    "Input": Section.INPUT, "Output": Section.OUTPUT, "InOut": Section.IN_OUT, "Static": Section.STATIC, "None": None,
}  # fmt: skip
"""Sections whose members an instance stores; a structure has the section None."""
_STRUCT: Final = re.compile(r"\bStruct\s*$", re.IGNORECASE)
_INDICES: Final = re.compile(r"-?[0-9]{1,9}(?:,-?[0-9]{1,9})*")
_MAX_NUMBER: Final = 65_535


def attribute(node: Node, name: str) -> str:
    """Return an attribute of a block, type, tag or constant; "" if it is missing."""
    return (node.findtext(f"AttributeList/{name}") or "").strip()


def comment_of(node: Node) -> str:
    """Return the first text of a tag's comment that is not empty."""
    texts = (text.text or "" for text in node.iterfind("ObjectList/MultilingualText[@CompositionName='Comment']//Text"))
    return next((text for text in texts if text.strip()), "")


def unit_of(file: str, root: Node, *, by_name: bool) -> Unit:
    """Return the declarations of a document.

    Args:
        file: Name of the file, for messages.
        root: The document.
        by_name: True to place members without regard to their addresses. Then the file's own list of
            the members of a system type is used; it does not say how they are stored.

    """
    unit = Unit()
    reader = _Reader(file, by_name=by_name)
    for node in root.iter():
        if node.tag == "SW.Types.PlcStruct":
            struct, _, faults = reader.interface(node)
            unit.types.append(TypeDeclaration(attribute(node, "Name"), struct, reader.at(node), faults=faults))
        elif node.tag == "SW.Blocks.FB":
            struct, _, faults = reader.interface(node)
            optimized = attribute(node, "MemoryLayout") != "Standard"
            constants = tuple(reader.constants(node))
            unit.types.append(
                TypeDeclaration(attribute(node, "Name"), struct, reader.at(node), constants, True, optimized, faults)
            )
        elif node.tag in ("SW.Blocks.GlobalDB", "SW.Blocks.InstanceDB"):
            unit.blocks.append(reader.block(node))
        elif node.tag == "SW.Tags.PlcUserConstant":
            unit.constants.append(reader.constant(node, attribute(node, "Name"), attribute(node, "Value")))
        elif node.tag == "Constant" and "value" in node.attrib:  # of TIA Portal's tag editor
            unit.constants.append(reader.constant(node, (node.text or "").strip(), node.attrib["value"]))
    return unit


class _Reader:
    """Reads the interfaces of one document."""

    def __init__(self, file: str, *, by_name: bool) -> None:
        self._file, self._by_name = file, by_name
        self._report = Report([file])
        self._assignments: list[Assignment] = []

    def at(self, node: Node) -> Position:
        """Return the place of an element."""
        return Position(self._file, node.line, 1)

    def block(self, node: Node) -> BlockDeclaration:
        """Return the declaration of a data block."""
        struct, assignments, faults = self.interface(node)
        number = attribute(node, "Number")
        body: Type = struct
        instance_of = attribute(node, "InstanceOfName")
        if instance_of and (not struct.members or (system_types.is_known(instance_of) and not self._by_name)):
            body = Named(instance_of, True, self.at(node))  # the file has only some members of a system type
        return BlockDeclaration(
            attribute(node, "Name"),
            int(number) if number.isdecimal() and len(number) <= 5 and 0 < int(number) <= _MAX_NUMBER else None,
            attribute(node, "MemoryLayout") != "Standard",
            body,
            tuple(self.constants(node)),
            assignments,
            self.at(node),
            faults,
        )

    def interface(self, node: Node) -> tuple[Struct, tuple[Assignment, ...], tuple[Diagnostic, ...]]:
        """Return the members of a block or type, the values of array elements, and faults."""
        self._report, self._assignments = Report([self._file]), []
        members = tuple(self._of_sections(node.find("AttributeList/Interface"), (), (), 0))
        faults = (*self._report.errors, *self._report.warnings)
        return Struct(members, self.at(node)), tuple(self._assignments), faults

    def constants(self, node: Node) -> Iterator[ConstantDeclaration]:
        """Yield the constants of a block's interface."""
        for member in node.iterfind("AttributeList/Interface/Sections/Section[@Name='Constant']/Member"):
            yield self.constant(member, member.get("Name", ""), (member.findtext("StartValue") or "").strip())

    def constant(self, node: Node, name: str, value: str) -> ConstantDeclaration:
        """Return the declaration of a constant."""
        return ConstantDeclaration(name, value, parser.parse_number(self.at(node), value), self.at(node))

    def _of_sections(
        self, holder: Node | None, path: tuple[str, ...], ranks: tuple[int, ...], depth: int
    ) -> Iterator[Member]:
        """Yield the members of the sections below ``Sections``, in the order in which they are stored."""
        if holder is None:
            return
        sections = [one for one in holder.iterfind("Sections/Section") if one.get("Name") in _SECTIONS]
        order = list(_SECTIONS)
        for section in sorted(sections, key=lambda one: order.index(one.get("Name", ""))):
            kind = _SECTIONS[section.get("Name", "")]
            for member in self._members(section, path, ranks, depth):
                yield replace(member, section=kind)

    def _members(self, holder: Node, path: tuple[str, ...], ranks: tuple[int, ...], depth: int) -> Iterator[Member]:
        """Yield the members that are elements below ``holder``.

        Args:
            holder: A section or a member.
            path: The names of the structures around them.
            ranks: For each of these names, the number of dimensions of the array.
            depth: The number of structures around them.

        """
        for node in holder.iterfind("Member"):
            name, position = node.get("Name", ""), self.at(node)
            if not name or depth >= MAX_DEPTH:
                what = "a member has no name" if not name else f"structures are nested more than {MAX_DEPTH} deep"
                self._report.add(position.error(what))
                continue
            kind = self._type(node, (*path, name), ranks, depth)
            if kind is None:
                continue
            comment = next((text.text or "" for text in node.iterfind("Comment/MultiLanguageText") if text.text), "")
            start = node.find("StartValue")
            value = "" if start is None else (start.text or "").strip() or start.get("ConstantName", "")
            rank = len(kind.bounds) if isinstance(kind, Array) else 0
            self._elements(node, (*path, name), (*ranks, rank))
            yield Member(name, kind, " ".join(comment.split())[:1000], value or None, position)

    def _type(self, node: Node, path: tuple[str, ...], ranks: tuple[int, ...], depth: int) -> Type | None:
        """Return the type of a member; report an error and return None if it has none."""
        text, position = node.get("Datatype", ""), self.at(node)
        struct = _STRUCT.search(text)
        kind = parser.parse_type(position, f"{text[: struct.start()]}Bool" if struct else text, self._report)
        if kind is None:
            return None
        element = kind.element if isinstance(kind, Array) else kind
        own = (*ranks, len(kind.bounds) if isinstance(kind, Array) else 0)
        inner: tuple[Member, ...] = ()
        if struct:
            inner = (*self._members(node, path, own, depth + 1), *self._of_sections(node, path, own, depth + 1))
            if not inner:
                self._report.add(position.error("expected at least one member in the structure"))
                return None
        elif isinstance(element, Named) and (
            element.quoted or (self._by_name and element.length is None and element_type(element.name) is None)
        ):
            inner = tuple(self._of_sections(node, path, own, depth + 1))
        if not inner:
            return kind
        body = Struct(inner, position)
        return Array(kind.bounds, body, position) if isinstance(kind, Array) else body

    def _elements(self, node: Node, path: tuple[str, ...], ranks: tuple[int, ...]) -> None:
        """Note the initial values of array elements.

        The attribute Path has the indices of all arrays around a value, from the outermost.
        """
        for element in node.iterfind("Subelement"):
            start = element.find("StartValue")
            value = "" if start is None else (start.text or "").strip()
            if not value:
                continue
            text = element.get("Path", "").replace(" ", "")
            indices = list(map(int, text.split(","))) if _INDICES.fullmatch(text) else []
            if len(indices) != sum(ranks):
                self._report.add(self.at(element).warning(f"the initial value of the element {text!r} is ignored"))
                continue
            target: list[str | tuple[int, ...]] = []
            for name, rank in zip(path, ranks, strict=True):
                target.append(name)
                if rank:
                    target.append(tuple(indices[:rank]))
                    del indices[:rank]
            self._assignments.append(Assignment(tuple(target), value, self.at(element)))
