"""Lists the variables of an OPC UA server, with the types and addresses that a tag table needs.

The search follows the hierarchical references from the folder Objects, level by level. It visits each
node once, so that loops of references end. It lists no children of a variable that fits a register.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua import ua_binary

from shmio.connectors.browsing import Browsed, Offer, Wanted
from shmio.connectors.opcua import decode
from shmio.connectors.opcua.data_types import DataTypes
from shmio.connectors.opcua.decode import Extension, Sample
from shmio.connectors.opcua.options import Credentials, OpcUaOptions
from shmio.connectors.opcua.session import Session
from shmio.connectors.opcua.structures import AbsentError, Listed, members_of, read_value
from shmio.connectors.opcua.values import MismatchError
from shmio.layout.addresses.opcua import escaped_uri, member_text, node_text
from shmio.layout.topic import shorten

_OBJECTS: Final = ua.NodeId(85)
_LEFT_OUT: Final = frozenset({ua.NodeId(2253), ua.NodeId(23470), ua.NodeId(31915)})
"""The objects Server, Aliases and Locations. Every server has them, so the search skips them."""
_HAS_PROPERTY: Final = ua.NodeId(46)
_NODES_AT_ONCE: Final = 20
"""Maximum number of nodes in a browse request. More would block the event loop for too long."""
_VALUES_AT_ONCE: Final = 100
REFERENCES_PER_NODE: Final = 30
"""Maximum number of references, as a multiple of the limit of nodes; some lead to properties or known nodes."""
MAX_CHARACTERS: Final = 1 << 26
"""Maximum number of characters of all names, identifiers and comments together."""
MAX_MEMBERS: Final = 1000
"""Maximum number of members of a structure that are listed."""
_MAX_COMMENT: Final = 1000
_WRITE: Final = 2
"""The bit CurrentWrite of an access level."""
_TYPES: Final = {
    decode.BOOLEAN: "BOOL", decode.SBYTE: "SINT", decode.BYTE: "USINT", decode.INT16: "INT", decode.UINT16: "UINT",
    decode.INT32: "DINT", decode.UINT32: "UDINT", decode.INT64: "LINT", decode.UINT64: "ULINT", decode.FLOAT: "REAL",
    decode.DOUBLE: "LREAL", decode.STRING: "STRING", decode.DATE_TIME: "LDT", decode.GUID: "STRING",
    decode.XML: "STRING", decode.NODE_ID: "STRING", decode.EXPANDED_NODE_ID: "STRING", decode.STATUS_CODE: "UDINT",
    decode.QUALIFIED_NAME: "STRING", decode.LOCALIZED_TEXT: "STRING",
}  # fmt: skip
_DERIVED: Final = {29: decode.INT32, 290: decode.DOUBLE, 294: decode.DATE_TIME}
"""The built-in types of Enumeration, Duration and UtcTime, by the numbers of these data types."""


def browse(options: OpcUaOptions, credentials: Credentials, wanted: Wanted) -> Browsed:
    """List the objects and variables that a server offers.

    Raises:
        ConnectorError: The server cannot be reached, or refuses the session or a request.

    """
    return asyncio.run(_browse(options, credentials, wanted))


async def _browse(options: OpcUaOptions, credentials: Credentials, wanted: Wanted) -> Browsed:
    session = Session(options, credentials, [], lambda _: None)
    healthy = False
    try:
        await session.open()
        try:
            found = await _Search(session, wanted).run()
        except Exception as error:  # noqa: BLE001  whatever a server sends, the search has failed
            raise session.explained(error) from None
        healthy = True
        return found
    finally:
        await session.close(polite=healthy)


@dataclass(eq=False)
class _Node:
    id: Any
    names: tuple[str, ...]
    is_variable: bool
    unit: Any = None
    """Node id of the variable's EngineeringUnits."""
    is_whole: bool = False
    """True if the node's value was listed, as one register or by its members; its children are then skipped."""
    children: list[_Node] = field(default_factory=list)


class _Search:
    def __init__(self, session: Session, wanted: Wanted) -> None:
        self._session, self._wanted = session, wanted
        self._seen = {_OBJECTS}
        self._types = DataTypes(session)
        self._found = Browsed()
        self._uris: list[str] = []
        self._references = self._characters = 0

    async def run(self) -> Browsed:
        """Search level by level."""
        self._uris = await self._session.namespaces()
        level = [_Node(_OBJECTS, (), is_variable=False)]
        for depth in range(self._wanted.depth + 1):
            for at in range(0, len(level), _NODES_AT_ONCE):
                await self._look_into(level[at : at + _NODES_AT_ONCE])
            for at in range(0, len(level), _VALUES_AT_ONCE):
                await self._list(level[at : at + _VALUES_AT_ONCE])
            level = [child for one in level if not one.is_whole for child in one.children]
            if not level:
                break
            if depth == self._wanted.depth:
                names = "/".join(level[0].names)
                self._stop(f"{shorten(names, 200)} is deeper than {depth} levels; set --depth")
        return self._found

    @property
    def _room(self) -> int:
        """Number of references that the search may still visit; 0 or less if it must end."""
        if len(self._seen) >= self._wanted.nodes or self._characters > MAX_CHARACTERS:
            return 0
        left = self._wanted.nodes * REFERENCES_PER_NODE - self._references
        return min(left, self._wanted.nodes - len(self._seen)) if self._wanted.everything else left

    def _stop(self, why: str) -> None:
        self._found.incomplete = self._found.incomplete or why

    async def _look_into(self, nodes: Sequence[_Node]) -> None:
        """Find the children of nodes, and add them to the nodes."""
        room = self._room
        if room <= 0:
            return
        references, left_out = await self._session.browse([node.id for node in nodes], room)
        self._references += sum(map(len, references))
        for node, found in zip(nodes, references, strict=True):
            for one in found:
                self._add(node, one)
        if left_out or self._references >= self._wanted.nodes * REFERENCES_PER_NODE:
            self._stop(
                f"the server sends more references than {self._wanted.nodes} nodes need; select a part of the "
                "server by a PATTERN, or set --limit"
            )

    def _add(self, parent: _Node, reference: Any) -> None:
        target, name = reference.NodeId, reference.BrowseName.Name or ""
        key = ua.NodeId(target.Identifier, target.NamespaceIndex)
        if getattr(target, "ServerIndex", 0) or key in _LEFT_OUT or not name:
            return
        if reference.ReferenceTypeId == _HAS_PROPERTY:
            if parent.is_variable and name == "EngineeringUnits":
                parent.unit = key
            return
        names = (*parent.names, name)
        if key in self._seen or not self._wanted.enters(names):
            return
        if len(self._seen) >= self._wanted.nodes:
            self._stop(
                f"the server has more than {self._wanted.nodes} nodes; select a part of the server by a PATTERN, "
                "or set --limit"
            )
            return
        self._count(name, key.Identifier)
        if self._characters > MAX_CHARACTERS:
            self._stop("the names of the server's nodes are too long; select a part of the server by a PATTERN")
            return
        self._seen.add(key)
        parent.children.append(_Node(key, names, reference.NodeClass == ua.NodeClass.Variable))

    def _count(self, *texts: object) -> None:
        """Count the characters of stored texts."""
        self._characters += sum(len(one) for one in texts if isinstance(one, str | bytes))

    async def _list(self, nodes: Sequence[_Node]) -> None:
        """Add nodes to the result, and read the types of variables."""
        variables = [node for node in nodes if node.is_variable]
        ids = [node.id for node in variables]
        names = ua.AttributeIds
        details = [
            dict(zip(variables, await self._session.read(ids, attribute), strict=True))
            for attribute in (names.Value, names.DataType, names.Description, names.UserAccessLevel)
        ] if ids else [{}, {}, {}, {}]  # fmt: skip
        # If the members of a structure are nodes too, list these nodes instead: they can be written.
        structures = [one for one in variables if not one.children and details[0][one].kind == decode.EXTENSION]
        if structures:
            await self._types.learn([node.id for node in structures])
        with_units = [node for node in variables if node.unit is not None]
        read = await self._session.read([node.unit for node in with_units], names.Value) if with_units else []
        units = {node: _unit(sample) for node, sample in zip(with_units, read, strict=True)}
        for node in nodes:
            if not node.names:
                continue
            if not node.is_variable:
                if self._wanted.takes(node.names):
                    self._found.offers.append(Offer(node.names))
                continue
            value, data_type, description, access = (one[node] for one in details)
            if node in structures:
                self._list_members(node, value)
                continue
            kind, refused = _type(value, data_type)
            node.is_whole = bool(kind)
            comment = shorten(description.value, _MAX_COMMENT) if isinstance(description.value, str) else ""
            self._count(comment)
            columns = {
                "address": self._address(node.id),
                "unit": units.get(node, ""),
                "comment": comment if comment != node.names[-1] else "",
                "writable": access.kind == decode.BYTE and bool(access.value & _WRITE),
            }
            if self._wanted.takes(node.names):
                self._found.offers.append(Offer(node.names, kind, columns, refused))

    def _list_members(self, node: _Node, value: Sample) -> None:
        """Add the members of a structure to the result."""
        kept: list[Listed] = []
        try:
            kept += itertools.islice(members_of(read_value(self._types.structures, value)), MAX_MEMBERS + 1)
            problem = f"a structure with more than {MAX_MEMBERS} members; write those you need into the tag table"
        except (MismatchError, AbsentError) as error:
            problem = str(error)
        if not 0 < len(kept) <= MAX_MEMBERS:
            if self._wanted.takes(node.names):
                self._found.offers.append(Offer(node.names, refused=problem))
            return
        node.is_whole = True
        address = self._address(node.id)
        for one in kept:
            steps = [[step] if isinstance(step, str) else map(str, step) for step in one.member]
            names = (*node.names, *itertools.chain.from_iterable(steps))
            if not self._wanted.takes(names):
                continue
            kind, refused = ("", one.refused) if one.refused else _type(one.sample, one.sample)
            columns = {"address": f"{address}{member_text(one.member)}"}
            self._count(*names, columns["address"])
            if self._characters > MAX_CHARACTERS:
                self._stop("the names of the server's members are too long; select a part of the server by a PATTERN")
                return
            self._found.offers.append(Offer(names, kind, columns, refused))

    def _address(self, node: Any) -> str:
        """Return a node's address with the URI of its namespace, since the namespace's number may change."""
        text = node_text(ua.NodeId(node.Identifier).to_string())
        number = node.NamespaceIndex
        if not number:
            return text
        uri = self._uris[number] if number < len(self._uris) else ""
        return f"nsu={escaped_uri(uri)};{text}" if uri else f"ns={number};{text}"


def _type(value: Sample, data_type: Sample) -> tuple[str, str]:
    """Return the register type of a variable, or the reason why there is none."""
    kind, dims = value.kind, value.dims
    if not kind:
        text = str(data_type.value) if data_type.kind == decode.NODE_ID else ""
        number = int(text[2:]) if text.startswith("i=") else 0
        kind, dims = _DERIVED.get(number, number), None
    base = _TYPES.get(kind)
    if base is None:
        name = decode.NAMES[kind] if 0 < kind < len(decode.NAMES) else ""
        return "", f"a {name} cannot be a register" if name else "it has no value, and its type is unknown"
    if dims is None:
        return base, ""
    if not all(dims):
        return "", "an array without elements; give it values, or write its length into the tag table"
    return f"ARRAY[{', '.join(f'0..{size - 1}' for size in dims)}] OF {base}", ""


def _unit(sample: Sample) -> str:
    """Return the text of an EUInformation; empty if it has none."""
    if sample.kind != decode.EXTENSION or not isinstance(sample.value, Extension):
        return ""
    try:
        found = ua_binary.struct_from_binary(ua.EUInformation, Buffer(sample.value.body))
    except Exception:  # noqa: BLE001  a wrong unit must not end the search
        return ""
    return str(found.DisplayName.Text or "")
