"""Asks a server for the definitions of the structures that it sends (OPC 10000-3, section 5.8.3)."""

from __future__ import annotations

import dataclasses
import enum
import re
import typing
import uuid
from base64 import b64decode
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, Final, Protocol

from asyncua import ua

from shmio.connectors.opcua import decode
from shmio.connectors.opcua.decode import Extension, MalformedError, NodeKey, Reader, Sample, node_key
from shmio.connectors.opcua.structures import (
    NULL,
    DefinedField,
    Definition,
    Field,
    Structure,
    complete,
    read_definition,
)

MAX_TYPES: Final = 1000
"""Maximum number of data types whose definitions a source reads."""
_MAX_ANCESTORS: Final = 16
_HAS_ENCODING, _HAS_SUBTYPE = 38, 45
_TEXT: Final = re.compile(r"(?:ns=([0-9]+);)?([isgb])=(.*)", re.DOTALL)
_ABSTRACT: Final = {26: decode.VARIANT, 27: decode.VARIANT, 28: decode.VARIANT, 29: decode.INT32}
"""The encodings of values whose data type is Number, Integer, UInteger or Enumeration."""

Structures = Mapping[NodeKey, Structure]
"""Structures by the node ids of their encodings."""


class Asked(Protocol):
    """The part of a session that :class:`DataTypes` needs."""

    async def read(self, nodes: Sequence[Any], attribute: Any) -> list[Sample]:
        """Read an attribute of nodes."""

    async def origins(self, nodes: Sequence[Any], reference: Any) -> list[Any]:
        """For each node, return a node that refers to it by ``reference``; None if there is none."""


class DataTypes:
    """The structures that nodes have as values, as far as the server defines these structures."""

    def __init__(self, session: Asked) -> None:
        """Create the object without a request; :meth:`learn` sends the requests."""
        self._session = session
        self._definitions: dict[NodeKey, Definition] = {}
        self._abstract: set[NodeKey] = set()
        self._kinds: dict[NodeKey, int] = {}
        self._built: dict[NodeKey, Structure] = {}
        self._names: dict[NodeKey, str] = {}
        self.structures: dict[NodeKey, Structure] = {}
        """The structures, by the node ids of their encodings."""

    async def learn(self, nodes: Sequence[Any]) -> None:
        """Ask the server for the definitions of the structures that nodes have as values.

        Raises:
            ConnectorError: The session fails, or the server refuses a request.

        """
        values = await self._session.read(nodes, ua.AttributeIds.Value)
        types = await self._session.read(nodes, ua.AttributeIds.DataType)
        encodings = {key for one in values for key in encodings_of(one)} - {NULL}
        declared = [_key(one) for one in types]
        await self._define({key for key in declared if key is not None})
        by_encoding = {one.encoding: key for key, one in self._definitions.items() if one.encoding != NULL}
        unknown = sorted(encodings - by_encoding.keys(), key=repr)
        if unknown:  # values of subtypes, or definitions without their encodings
            found = await self._session.origins([_node(key) for key in unknown], ua.NodeId(_HAS_ENCODING))
            pairs = zip(unknown, found, strict=True)
            given = {key: _standard_origin(key) if node is None else _key_of(node) for key, node in pairs}
            origins = {key: origin for key, origin in given.items() if origin is not None}
            await self._define({*origins.values()})
            by_encoding |= {key: origin for key, origin in origins.items() if origin in self._definitions}
        await self._name()
        for encoding, key in by_encoding.items():
            self.structures[encoding] = self._structure(key)

    async def _define(self, wanted: set[NodeKey]) -> None:
        """Read the definitions of data types and of the data types of their members, level by level."""
        while wanted := {key for key in wanted if not self._is_known(key)}:
            level = sorted(wanted, key=repr)[: max(0, MAX_TYPES - len(self._definitions) - len(self._kinds))]
            if not level:
                return
            nodes = [_node(key) for key in level]
            samples = await self._session.read(nodes, ua.AttributeIds.DataTypeDefinition)
            abstract = await self._session.read(nodes, ua.AttributeIds.IsAbstract)
            others: list[NodeKey] = []
            wanted = set()
            for key, sample, is_abstract in zip(level, samples, abstract, strict=True):
                try:
                    definition = read_definition(sample)
                except MalformedError:  # only the members of this structure cannot be read
                    definition = None
                definition = definition or standard_definition(key)
                if definition is None:
                    others.append(key)
                    continue
                self._definitions[key] = definition
                wanted |= {one.data_type for one in definition.fields}
                if is_abstract.kind == decode.BOOLEAN and is_abstract.value is True:
                    self._abstract.add(key)
            await self._find_kinds(others)

    def _is_known(self, key: NodeKey) -> bool:
        return key in self._definitions or key in self._kinds or _built_in(key) != 0

    async def _find_kinds(self, keys: Sequence[NodeKey]) -> None:
        """Find the built-in types from which data types are derived."""
        ancestors = {key: key for key in keys}
        self._kinds |= dict.fromkeys(keys, 0)
        for _ in range(_MAX_ANCESTORS):
            if not ancestors:
                return
            level = sorted({*ancestors.values()}, key=repr)
            found = await self._session.origins([_node(key) for key in level], ua.NodeId(_HAS_SUBTYPE))
            parents = {key: _key_of(node) for key, node in zip(level, found, strict=True) if node is not None}
            following: dict[NodeKey, NodeKey] = {}
            for key, ancestor in ancestors.items():
                parent = parents.get(ancestor)
                if parent is None:
                    continue
                self._kinds[key] = _built_in(parent)
                if not self._kinds[key]:
                    following[key] = parent
            ancestors = following

    async def _name(self) -> None:
        """Read the names of the structures, for messages."""
        keys = [key for key in self._definitions if key not in self._names]
        names = await self._session.read([_node(key) for key in keys], ua.AttributeIds.DisplayName) if keys else []
        for key, sample in zip(keys, names, strict=True):
            self._names[key] = sample.value[:100] if isinstance(sample.value, str) else ""

    def _structure(self, key: NodeKey) -> Structure:
        """Return the structure of a data type in ``_definitions``, complete with the structures inside it."""
        if key in self._built:
            return self._built[key]
        waiting = [key]
        while waiting:
            one = waiting.pop()
            structure = self._open(one)
            definition = self._definitions[one]
            fields: list[Field] = []
            for declared in definition.fields:
                inner: Structure | None = None
                kind = _built_in(declared.data_type) or self._kinds.get(declared.data_type, 0)
                if declared.data_type in self._abstract:
                    kind = decode.EXTENSION
                elif declared.data_type in self._definitions:
                    if declared.data_type not in self._built:
                        waiting.append(declared.data_type)
                    inner = self._open(declared.data_type)
                rank = 0 if declared.rank == -1 else declared.rank if declared.rank > 0 else -1
                fields.append(Field(declared.name, kind, inner, rank, declared.optional))
            complete(structure, definition.form, fields)
        return self._built[key]

    def _open(self, key: NodeKey) -> Structure:
        return self._built.setdefault(key, Structure(self._names.get(key) or str(key[2])[:100]))


@cache
def standard_definition(key: NodeKey) -> Definition | None:
    """Return the definition of a structure of the standard, which few servers define; None if it is none.

    The library has a class for each of them (OPC 10000-5).
    """
    of_type = _standard_classes().get(key)
    if of_type is None:
        return None
    try:
        hints = typing.get_type_hints(of_type, {"ua": ua})
    except (AttributeError, NameError):  # the library's own annotation is wrong
        return None
    fields = []
    for name in (one.name for one in dataclasses.fields(of_type)):
        inner, rank = hints[name], -1
        if typing.get_origin(inner) is list:
            (inner,), rank = typing.get_args(inner), 1
        data_type = _data_type(inner)
        if data_type is None:
            return None
        fields.append(DefinedField(name, data_type, rank, optional=False))
    return Definition(_key_of(ua.typeid_by_extension_objects[of_type]), 0, tuple(fields))


def _standard_origin(encoding: NodeKey) -> NodeKey | None:
    """Return the data type of the standard with this encoding; None if there is none."""
    of_type = ua.extension_objects_by_typeid.get(_node(encoding))
    return None if of_type is None else _key_of(of_type.data_type)


@cache
def _standard_classes() -> dict[NodeKey, Any]:
    return {_key_of(one.data_type): one for one in ua.typeid_by_extension_objects if not one.data_type.NamespaceIndex}


def _data_type(of_type: Any) -> NodeKey | None:
    """Return the data type for which the library uses a class; None if it is unknown."""
    if not isinstance(of_type, type):
        return None
    if of_type.__name__ in ua.VariantType.__members__:
        return 2, 0, ua.VariantType[of_type.__name__].value
    if issubclass(of_type, enum.Enum) and not issubclass(of_type, enum.Flag):
        return 2, 0, decode.INT32
    return _key_of(of_type.data_type) if hasattr(of_type, "data_type") else None


def encodings_of(sample: Sample) -> Iterable[NodeKey]:
    """Return the node ids of the encodings of the structures in a value, each once."""
    if sample.kind != decode.EXTENSION:
        return set()
    values = sample.value if sample.dims is not None else [sample.value]
    return {node_key(Reader(raw).node_id()) for raw in {one.encoding for one in values if isinstance(one, Extension)}}


def _built_in(key: NodeKey) -> int:
    """Return the built-in type that encodes a data type of the standard; 0 if there is none."""
    form, namespace, number = key
    if form != 2 or namespace or not isinstance(number, int):
        return 0
    return number if 0 < number <= decode.DIAGNOSTICS else _ABSTRACT.get(number, 0)


def _key(sample: Sample) -> NodeKey | None:
    """Return the node id that a sample holds; None if it holds anything else."""
    if sample.kind != decode.NODE_ID or sample.dims is not None:
        return None
    found = _TEXT.fullmatch(sample.value)
    if found is None:
        return None
    namespace, kind, identifier = int(found[1] or 0), found[2], found[3]
    if kind == "s":
        return 3, namespace, identifier
    if kind == "i":
        return 2, namespace, int(identifier)
    return (4, namespace, uuid.UUID(identifier).bytes_le) if kind == "g" else (5, namespace, b64decode(identifier))


def _key_of(node: Any) -> NodeKey:
    identifier = node.Identifier
    if isinstance(identifier, uuid.UUID):
        return 4, node.NamespaceIndex, identifier.bytes_le
    form = 3 if isinstance(identifier, str) else 5 if isinstance(identifier, bytes) else 2
    return form, node.NamespaceIndex, identifier


def _node(key: NodeKey) -> Any:
    form, namespace, identifier = key
    if form == 4 and isinstance(identifier, bytes):
        return ua.NodeId(uuid.UUID(bytes_le=identifier), namespace)
    return ua.NodeId(identifier, namespace)
