"""Import OPC UA information models (NodeSet2 XML): the variables of the objects that they declare."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from shmio.layout.addresses import siemens
from shmio.layout.addresses.opcua import escaped_uri, node_text
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.importing.xml_tree import Node
from shmio.layout.model import element_type

ROOT: Final = "UANodeSet"
# Node ids of namespace 0, as the specification numbers them (OPC 10000-6, Annex A).
_BUILT_IN: Final = {
    1: "BOOL", 2: "SINT", 3: "USINT", 4: "INT", 5: "UINT", 6: "DINT", 7: "UDINT", 8: "LINT", 9: "ULINT",
    10: "REAL", 11: "LREAL", 12: "STRING", 13: "LDT", 14: "STRING", 16: "STRING", 17: "STRING", 18: "STRING",
    19: "UDINT", 20: "STRING", 21: "STRING", 29: "DINT", 290: "LREAL", 294: "LDT",
}  # fmt: skip
_NAMES: Final = {
    "Boolean": 1, "SByte": 2, "Byte": 3, "Int16": 4, "UInt16": 5, "Int32": 6, "UInt32": 7, "Int64": 8, "UInt64": 9,
    "Float": 10, "Double": 11, "String": 12, "DateTime": 13, "Guid": 14, "XmlElement": 16, "NodeId": 17,
    "ExpandedNodeId": 18, "StatusCode": 19, "QualifiedName": 20, "LocalizedText": 21, "Enumeration": 29,
    "Duration": 290, "UtcTime": 294,
    "Organizes": 35, "HasSubtype": 45, "HasProperty": 46, "HasComponent": 47, "HasOrderedComponent": 49,
}  # fmt: skip
_PARENTS: Final = frozenset({"i=35", "i=46", "i=47", "i=49"})
_NODE: Final = re.compile(r"ns=([0-9]{1,5});(.+)", re.DOTALL)
_INSTANCES: Final = frozenset({"UAObject", "UAVariable"})
_MAX_DEPTH: Final = 100


class _Model:
    """The nodes of a file, by node id as written in the file."""

    def __init__(self, root: Node) -> None:
        self.aliases = {name: f"i={number}" for name, number in _NAMES.items()}
        self.aliases |= {one.get("Alias", ""): (one.text or "").strip() for one in root.iterfind("Aliases/Alias")}
        self.uris = [
            "http://opcfoundation.org/UA/",
            *((u.text or "").strip() for u in root.iterfind("NamespaceUris/Uri")),
        ]
        self.nodes: dict[str, Node] = {}
        for node in root:
            if node.get("NodeId"):
                self.nodes.setdefault(node.get("NodeId", ""), node)
        self.parents: dict[str, str] = {}
        self.units: dict[str, str] = {}
        for key, node in self.nodes.items():
            for reference in node.iterfind("References/Reference"):
                kind, other = self.real(reference.get("ReferenceType", "")), self.real((reference.text or "").strip())
                if kind in _PARENTS or (kind == "i=45" and node.tag == "UADataType"):
                    if reference.get("IsForward", "true").lower() in ("false", "0"):
                        self.parents.setdefault(key, other)
                    else:
                        self.parents.setdefault(other, key)
            if "ParentNodeId" in node.attrib:
                self.parents[key] = self.real(node.attrib["ParentNodeId"])
        for key, node in self.nodes.items():
            if _name(node) == "EngineeringUnits" and key in self.parents:
                text = node.findtext("Value//DisplayName/Text") or ""
                self.units[self.parents[key]] = text.strip()

    def real(self, name: str) -> str:
        return self.aliases.get(name, name)

    def way(self, key: str) -> tuple[list[str], str]:
        """Return the names from the topmost object down to a node, and why to leave the node out, or ""."""
        names: list[str] = []
        while key in self.nodes and len(names) <= _MAX_DEPTH:
            node = self.nodes[key]
            if node.tag not in _INSTANCES:
                kind = "an argument of a method" if node.tag == "UAMethod" else "part of a type, not of an object"
                return names, kind
            names.insert(0, _name(node))
            key = self.parents.get(key, "")
        return (names, "") if len(names) <= _MAX_DEPTH else (names, "its references form a loop")

    def type_of(self, kind: str) -> str | None:
        """Return the S7 type for a data type or for its nearest known supertype; None if there is none."""
        key = self.real(kind or "i=24")
        for _ in range(_MAX_DEPTH):
            known = _BUILT_IN.get(int(key[2:])) if re.fullmatch(r"i=[0-9]{1,9}", key) else None
            if known or key not in self.parents:
                return known
            key = self.parents[key]
        return None

    def siemens_type(self, kind: str) -> str | None:
        """Return the S7 type that a CPU's own data type is named after; None if the type is another.

        TIA Portal names the types of the CPU's namespace, such as BYTE and WORD, in the aliases.
        """
        key = self.real(kind)
        match = _NODE.fullmatch(key)
        if match is None or int(match[1]) >= len(self.uris) or self.uris[int(match[1])] != siemens.NAMESPACE:
            return None
        names = (name.strip('"') for name, other in self.aliases.items() if other == key)
        return next((name for name in names if element_type(name)), None)

    def address(self, key: str) -> str:
        """Return a node id with the URI of its namespace, because servers number namespaces differently."""
        match = _NODE.fullmatch(key)
        if match is None or int(match[1]) >= len(self.uris):
            return node_text(key)
        return f"nsu={escaped_uri(self.uris[int(match[1])])};{node_text(match[2])}"


def read(root: Node) -> Found:
    """Return the variables of all objects; raise ImportingError if the file has no nodes."""
    model = _Model(root)
    if not model.nodes:
        raise ImportingError("expected nodes below UANodeSet, found none")
    found = Found("an OPC UA NodeSet2")
    for node in root:
        key = node.get("NodeId", "")
        if node.tag == "UAVariable" and model.nodes.get(key) is not node:
            found.skip(_name(node), "the file has its node id twice" if key else "the node has no id", node.line)
        elif node.tag == "UAVariable":
            _add(found, model, key, node)
    return found


def _add(found: Found, model: _Model, key: str, node: Node) -> None:
    names, problem = model.way(key)
    shown = "/".join(names)
    if problem:
        return found.skip(shown or _name(node), problem, node.line)
    kind = model.type_of(node.get("DataType", "")) or model.siemens_type(node.get("DataType", ""))
    if kind is None:
        return found.skip(shown, f"the type {node.get('DataType', 'BaseDataType')} has no counterpart", node.line)
    elements = _elements(node.attrib)
    if elements is None:
        return found.skip(shown, "an array without fixed lengths", node.line)
    access = node.get("AccessLevel", "1")
    rights = int(access) if access.isdecimal() and len(access) < 10 else 1
    if not rights & 1:
        return found.skip(shown, "the variable cannot be read", node.line)
    return found.add(
        tuple(names),
        f"{elements}{kind}",
        {
            "address": model.address(key),
            "unit": model.units.get(key),
            "comment": (node.findtext("Description") or "").strip(),
            "writable": bool(rights & 2),
        },
        node.line,
    )


def _elements(node: Mapping[str, str]) -> str | None:
    """Return ``ARRAY[0..9] OF `` for an array, "" for a scalar, None for an array without fixed lengths."""
    rank = node.get("ValueRank", "-1")
    if rank == "-1":
        return ""
    lengths = [part.strip() for part in node.get("ArrayDimensions", "").split(",")]
    if (int(rank) if rank.isdecimal() and len(rank) < 3 else 0) not in (0, len(lengths)):
        return None
    if not all(part.isdecimal() and len(part) < 8 and int(part) for part in lengths):
        return None
    return f"ARRAY[{', '.join(f'0..{int(part) - 1}' for part in lengths)}] OF "


def _name(node: Node) -> str:
    """Return a node's name without its namespace, as clients show it."""
    name = node.get("BrowseName", "")
    index, colon, rest = name.partition(":")
    return rest if colon and index.isdecimal() else name
