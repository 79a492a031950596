"""The address space: the nodes of the standard, which come from asyncua, and those of the instance."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.server.address_space import AddressSpace, NodeData
from asyncua.ua.ua_binary import struct_to_binary

from shmio.endpoints.opcua.feed import Feed, Watch
from shmio.endpoints.opcua.nodes import (
    NAMESPACE,
    OBJECTS,
    ROOT,
    Method,
    Node,
    RegisterNode,
    Roles,
    SourceNode,
    VariableNode,
)
from shmio.endpoints.opcua.parts import PartOfVariable, check_range
from shmio.endpoints.shares import Share
from shmio.errors import PathError
from shmio.layout.topic import find

MAX_IDENTIFIER: Final = 4096
"""Maximum length of a node id, in characters."""
_ANY: Final = ua.NodeId()

Reference = Any  # ua.ReferenceDescription


class Space:
    """All nodes that clients see. Use it only in the event loop's thread."""

    def __init__(self, instance: str, standard: AddressSpace) -> None:
        self.root = Node(ROOT, instance, None)
        self.sources: dict[str, SourceNode] = {}
        self._standard = standard
        self._static: dict[tuple[ua.NodeId, int], StaticWatch] = {}
        self._supertypes: dict[ua.NodeId, frozenset[ua.NodeId]] = {}
        standard[OBJECTS].references.append(self.root.description())

    def add(self, source: SourceNode) -> None:
        """Add a source. It takes over the watches of an earlier source with the same name."""
        before = self.sources.get(source.name)
        self.sources[source.name] = self.root.children[source.name] = source
        if before is not None:
            self._move(before.feed, source)

    def remove(self, name: str) -> None:
        """Remove a source. Clients that monitor its variables get the status BadNodeIdUnknown."""
        source = self.sources.pop(name)
        del self.root.children[name]
        for watch in source.feed.watches:
            source.feed.adopt(watch, None, None)

    def _move(self, old: Feed, source: SourceNode) -> None:
        for watch in old.watches:
            node = self.find(ua.NodeId(watch.key, NAMESPACE))
            if isinstance(node, RegisterNode):
                part = PartOfVariable(node, watch.index_range) if watch.index_range else node
                source.feed.adopt(watch, node.register.path, part)
            else:
                source.feed.adopt(watch, None, node if isinstance(node, VariableNode) else None)

    # ---- look up -----------------------------------------------------------------------------------------------------

    def find(self, node_id: ua.NodeId) -> Node | None:
        """Return the instance's node with this id; None if there is none.

        Elements, slices and bits of registers have ids, too.
        """
        if node_id.NamespaceIndex != NAMESPACE:
            return None
        if node_id == ROOT:
            return self.root
        text = node_id.Identifier
        if not isinstance(text, str) or len(text) > MAX_IDENTIFIER:
            return None
        path, mark, name = text.partition("#")
        node = self._at(path)
        if not mark or node is None:
            return node if path else None
        owner, inner, last = name.partition("#")
        named = node.property_named(owner) if isinstance(node, RegisterNode) else node.children.get(f"#{owner}")
        if not inner:
            return named
        return named.property_named(last) if isinstance(named, Method) else None

    def _at(self, path: str) -> Node | None:
        if not path:
            return self.root
        first, _, rest = path.partition("/")
        source = self.sources.get(first)
        return None if source is None else source.by_path.get(rest) or self._part(source, rest)

    def _part(self, source: SourceNode, path: str) -> Node | None:
        """Return the node of an element, a slice or a bit. Clients can use such nodes but not browse to them."""
        try:
            register = find(source.feed.block.layout, path)
        except PathError:
            return None
        if register.path != path:
            return None  # each node has only one id
        holder: Node | None = None
        above = path
        while holder is None:
            above = above.rpartition("/")[0]
            holder = source.by_path.get(above)
        name = path.rpartition("/")[2]
        return RegisterNode(ua.NodeId(f"{source.name}/{path}", NAMESPACE), name, holder, source.feed, register)

    def knows(self, node_id: ua.NodeId) -> bool:
        """Return whether there is a node with this id."""
        return self.find(node_id) is not None or node_id in self._standard

    def read(self, node_id: ua.NodeId, attribute: int, roles: Roles) -> ua.DataValue:
        """Return an attribute of a node, as a client with these roles sees it."""
        node = self.find(node_id)
        if node is not None:
            return node.read(attribute, roles)
        return self._standard.read_attribute_value(node_id, attribute)

    # ---- references --------------------------------------------------------------------------------------------------

    def references(self, node_id: ua.NodeId) -> Iterator[Reference] | None:
        """Return the references from a node; None if there is no such node."""
        node = self.find(node_id)
        if node is not None:
            return node.references()
        found: NodeData | None = self._standard.get(node_id)
        return None if found is None else iter(found.references)

    def browse(self, asked: ua.BrowseDescription) -> Iterator[Reference | None] | None:
        """Return the references from a node; None if there is no such node.

        In place of a reference that the description does not select, the iterator has None, so that many
        of these do not delay other clients.
        """
        found = self.references(asked.NodeId)
        return None if found is None else (one if self._suits(asked, one) else None for one in found)

    def _suits(self, asked: ua.BrowseDescription, reference: Reference) -> bool:
        if asked.BrowseDirection == ua.BrowseDirection.Forward and not reference.IsForward:
            return False
        if asked.BrowseDirection == ua.BrowseDirection.Inverse and reference.IsForward:
            return False
        if asked.NodeClassMask and not asked.NodeClassMask & reference.NodeClass:
            return False
        return self._is_type(reference.ReferenceTypeId, asked.ReferenceTypeId, subtypes=asked.IncludeSubtypes)

    def _is_type(self, reference: ua.NodeId, asked: ua.NodeId, *, subtypes: bool) -> bool:
        if asked in (_ANY, reference):
            return True
        return subtypes and asked in self._above(reference)

    def _above(self, reference: ua.NodeId) -> frozenset[ua.NodeId]:
        """Return the supertypes of a reference type."""
        if reference not in self._supertypes:
            above, at = set[ua.NodeId](), reference
            while (data := self._standard.get(at)) is not None:
                parents = [
                    one.NodeId for one in data.references
                    if not one.IsForward and one.ReferenceTypeId == ua.NodeId(ua.ObjectIds.HasSubtype)
                ]  # fmt: skip
                if not parents or parents[0] in above:
                    break
                at = parents[0]
                above.add(at)
            self._supertypes[reference] = frozenset(above)
        return self._supertypes[reference]

    async def follow(self, start: ua.NodeId, elements: list[ua.RelativePathElement], share: Share) -> list[ua.NodeId]:
        """Return the nodes at the end of a path of browse names.

        Args:
            start: The node at which the path starts.
            elements: The path.
            share: The client's share of the time.

        Raises:
            ServiceError: The start node does not exist, or a name is empty.

        """
        if not elements or any(not element.TargetName or not element.TargetName.Name for element in elements):
            raise ServiceError(ua.StatusCodes.BadBrowseNameInvalid)
        if not self.knows(start):
            raise ServiceError(ua.StatusCodes.BadNodeIdUnknown)
        found = {start: None}
        for element in elements:
            before, found = found, {}
            for node in before:
                found.update(dict.fromkeys(self._targets(node, element)))
                await share.turn()
        return list(found)

    def _targets(self, node_id: ua.NodeId, element: ua.RelativePathElement) -> Iterator[ua.NodeId]:
        node = self.find(node_id)
        references = node.references_named(element.TargetName.Name) if node else self.references(node_id)
        for reference in references or ():
            if (
                reference.BrowseName == element.TargetName
                and reference.IsForward != element.IsInverse
                and self._is_type(reference.ReferenceTypeId, element.ReferenceTypeId, subtypes=element.IncludeSubtypes)
            ):
                yield reference.NodeId

    # ---- changes -----------------------------------------------------------------------------------------------------

    def watch(self, node_id: ua.NodeId, attribute: int, roles: Roles, index_range: str = "") -> tuple[Watch, float]:
        """Return the watch of an attribute, and the shortest time between two changes, in ms.

        Args:
            node_id: The node.
            attribute: The attribute.
            roles: Roles of the client.
            index_range: The part of the attribute; "" for all of it.

        Raises:
            ServiceError: There is no such node or attribute, or the attribute cannot have such a part.

        """
        node = self.find(node_id)
        if index_range:
            check_range(index_range)
        if isinstance(node, VariableNode) and attribute == ua.AttributeIds.Value:
            if index_range and isinstance(node, RegisterNode):
                part = PartOfVariable(node, index_range)
                if part.is_missing():
                    raise ServiceError(ua.StatusCodes.BadIndexRangeNoData)
                return node.feed.watch(node.register.path, part, index_range), node.period_ms
            found = None if index_range else node.watch()
            if found is not None:
                return found, node.period_ms
        if index_range:
            raise ServiceError(ua.StatusCodes.BadIndexRangeNoData)  # nothing else has a value that changes in parts
        value = self.read(node_id, attribute, roles)
        if value.StatusCode is not None and value.StatusCode.value in (
            ua.StatusCodes.BadNodeIdUnknown,
            ua.StatusCodes.BadAttributeIdInvalid,
        ):
            raise ServiceError(value.StatusCode.value)
        key = (node_id, attribute)
        if key not in self._static:
            self._static[key] = StaticWatch(
                self, key, None if node is not None else self._standard, lambda: self.read(node_id, attribute, roles)
            )
        return self._static[key], 0.0

    def forget(self, key: tuple[ua.NodeId, int]) -> None:
        """Remove a watch that has no listeners. ``key`` is its node and attribute."""
        self._static.pop(key, None)


class StaticWatch(Watch):
    """The watch of an attribute of a standard node, or of an attribute that never changes."""

    __slots__ = ("_handle", "_node", "_space", "_standard")

    def __init__(
        self,
        space: Space,
        node: tuple[ua.NodeId, int],
        standard: AddressSpace | None,
        get: Callable[[], ua.DataValue],
    ) -> None:
        super().__init__(_Unfollowed(), str(node), _Attribute(get))  # type: ignore[arg-type]  # it has the methods of a feed that a watch calls
        self._space, self._node, self._standard = space, node, standard
        self._handle = 0
        if standard is not None:
            _, self._handle = standard.add_datachange_callback(*node, self._changed)

    async def _changed(self, _handle: int, _value: Any, _error: Any = None) -> None:
        self.changed()

    def remove(self, listener: Any) -> None:
        """Remove a listener. The watch ends when its last listener is removed."""
        self.listeners.pop(listener, None)
        self._armed.pop(listener, None)
        if not self.listeners:
            if self._standard is not None:
                self._standard.delete_datachange_callback(self._handle)
            self._space.forget(self._node)


class _Attribute:
    """An attribute that clients monitor like a variable."""

    def __init__(self, get: Callable[[], ua.DataValue]) -> None:
        self.value = get

    def encoded(self) -> bytes:
        """Return the present value, encoded."""
        return struct_to_binary(self.value())


class _Unfollowed:
    """Substitute for a feed, for watches of attributes that no source changes."""

    def __init__(self) -> None:
        self.timed: dict[Any, Watch] = {}

    def count(self) -> None:
        """Do nothing."""

    def release(self, watch: Watch) -> None:
        """Do nothing."""
