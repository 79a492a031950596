"""The instance's nodes: objects by path, a variable for each register, properties and methods.

A node computes its attributes and references when a client asks for them. So a large cell starts
fast, and a value always comes from the newest frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary

from shmio.endpoints.opcua import values
from shmio.endpoints.opcua.feed import Feed, Readable, Watch
from shmio.layout.model import Register
from shmio.layout.topic import decode_segment, encode_segment
from shmio.local.reading import injected
from shmio.segment import Provenance

NAMESPACE: Final = 2
"""Index of the instance's own namespace."""
ROOT: Final = ua.NodeId(1, NAMESPACE)
OBJECTS: Final = ua.NodeId(ua.ObjectIds.ObjectsFolder)
_Ids = ua.AttributeIds
_Types = ua.VariantType

Roles = frozenset[str]


class Node:
    """A node of the instance. It is an object, unless a subclass says otherwise."""

    node_class = ua.NodeClass.Object
    type_definition = ua.ObjectIds.FolderType
    reference = ua.ObjectIds.Organizes
    """Type of the reference from the parent node to this node."""
    name_space = NAMESPACE
    """Index of the namespace of the browse name."""

    def __init__(self, node_id: ua.NodeId, name: str, parent: Node | None) -> None:
        self.id, self.name, self.parent = node_id, name, parent
        self.children: dict[str, Node] = {}

    def all_children(self) -> Iterator[Node]:
        """Yield the nodes directly below this one."""
        yield from self.children.values()

    def description(self, *, forward: bool = True, reference: int | None = None) -> ua.ReferenceDescription:
        """Describe this node as the target of a reference.

        Args:
            forward: Whether the reference leads forward to this node, not back.
            reference: Type of the reference; None for :attr:`reference`.
        """
        return ua.ReferenceDescription(
            ua.NodeId(self.reference if reference is None else reference),
            forward,
            self.id,
            ua.QualifiedName(self.name, self.name_space),
            ua.LocalizedText(self.name),
            self.node_class,
            ua.NodeId(self.type_definition) if self.type_definition else ua.NodeId(),
        )

    def references(self) -> Iterator[ua.ReferenceDescription]:
        """Yield the references from this node."""
        for child in self.all_children():
            yield child.description()
        yield from self._other_references()

    def references_named(self, name: str) -> Iterator[ua.ReferenceDescription]:
        """Yield the references from this node, of those to nodes below it only the ones with this name."""
        for child in self.named(name):
            yield child.description()
        yield from self._other_references()

    def named(self, name: str) -> Iterator[Node]:
        """Yield the nodes with this name directly below this one."""
        for key in (encode_segment(name), f"#{name}"):
            if key in self.children:
                yield self.children[key]

    def _other_references(self) -> Iterator[ua.ReferenceDescription]:
        """Yield the references to the node above this one, and to its type."""
        if self.parent is not None:
            yield self.parent.description(forward=False, reference=self.reference)
        else:
            yield ua.ReferenceDescription(
                ua.NodeId(ua.ObjectIds.Organizes), False, OBJECTS, ua.QualifiedName("Objects", 0),
                ua.LocalizedText("Objects"), ua.NodeClass.Object, ua.NodeId(ua.ObjectIds.FolderType),
            )  # fmt: skip
        if self.type_definition:
            kind = ua.NodeClass.ObjectType if self.node_class is ua.NodeClass.Object else ua.NodeClass.VariableType
            name = ua.ObjectIdNames[self.type_definition]
            yield ua.ReferenceDescription(
                ua.NodeId(ua.ObjectIds.HasTypeDefinition), True, ua.NodeId(self.type_definition),
                ua.QualifiedName(name, 0), ua.LocalizedText(name), kind, ua.NodeId(),
            )  # fmt: skip

    def read(self, attribute: int, roles: Roles) -> ua.DataValue:
        """Return an attribute, as a client with these roles sees it."""
        found = self._attribute(attribute, roles)
        if found is None:
            return bad(ua.StatusCodes.BadAttributeIdInvalid)
        return found if isinstance(found, ua.DataValue) else ua.DataValue(found)

    def _attribute(self, attribute: int, roles: Roles) -> ua.Variant | ua.DataValue | None:
        match attribute:
            case _Ids.NodeId:
                return ua.Variant(self.id, _Types.NodeId)
            case _Ids.NodeClass:
                return ua.Variant(self.node_class, _Types.Int32)
            case _Ids.BrowseName:
                return ua.Variant(ua.QualifiedName(self.name, self.name_space), _Types.QualifiedName)
            case _Ids.DisplayName:
                return ua.Variant(ua.LocalizedText(self.name), _Types.LocalizedText)
            case _Ids.Description:
                return ua.Variant(ua.LocalizedText(self.comment), _Types.LocalizedText)
            case _Ids.WriteMask | _Ids.UserWriteMask:
                return ua.Variant(0, _Types.UInt32)
            case _:
                return self._own(attribute, roles)

    @property
    def comment(self) -> str:
        """Description of the node."""
        return ""

    def _own(self, attribute: int, _roles: Roles) -> ua.Variant | ua.DataValue | None:
        return ua.Variant(0, _Types.Byte) if attribute == _Ids.EventNotifier else None


class VariableNode(Node):
    """A node with a value."""

    node_class = ua.NodeClass.Variable
    type_definition = ua.ObjectIds.BaseDataVariableType
    reference = ua.ObjectIds.HasComponent
    data_type: ua.NodeId
    sizes: list[int] = []  # noqa: RUF012  no list here is ever changed
    period_ms = 0.0
    writable = False

    def value(self) -> ua.DataValue:
        """Return the present value."""
        raise NotImplementedError

    def encoded(self) -> bytes:
        """Return the present value, encoded."""
        return struct_to_binary(self.value())

    def watch(self) -> Watch | None:
        """Return the watch of the variable's changes; None if its value never changes."""
        return None

    def _own(self, attribute: int, roles: Roles) -> ua.Variant | ua.DataValue | None:
        match attribute:
            case _Ids.Value:
                return self.value()
            case _Ids.DataType:
                return ua.Variant(self.data_type, _Types.NodeId)
            case _Ids.ValueRank:
                return ua.Variant(len(self.sizes) or -1, _Types.Int32)
            case _Ids.ArrayDimensions:
                return ua.Variant(self.sizes, _Types.UInt32, is_array=True)
            case _Ids.AccessLevel:
                return ua.Variant(3 if self.writable else 1, _Types.Byte)
            case _Ids.UserAccessLevel:
                return ua.Variant(3 if self.writable and "write" in roles else 1, _Types.Byte)
            case _Ids.MinimumSamplingInterval:
                return ua.Variant(self.period_ms, _Types.Double)
            case _Ids.Historizing:
                return ua.Variant(False, _Types.Boolean)
            case _:
                return None


class RegisterNode(VariableNode):
    """The variable of a register, or of an element, a slice or a bit of one."""

    def __init__(self, node_id: ua.NodeId, name: str, parent: Node | None, feed: Feed, register: Register) -> None:
        super().__init__(node_id, name, parent)
        self.feed, self.register = feed, register

    @property
    def type_definition(self) -> int:
        """The type of the variable: of a number with a unit and no range, or any (OPC 10000-8, section 5.3.2)."""
        analog = self.register.unit and values.is_number(self.register)
        return ua.ObjectIds.AnalogUnitType if analog else ua.ObjectIds.BaseDataVariableType

    @property
    def data_type(self) -> ua.NodeId:  # a property here, an attribute in other classes
        """Data type of the register's value, or of its elements."""
        return ua.NodeId(values.data_type(self.register).value)

    @property
    def sizes(self) -> list[int]:  # type: ignore[override]
        """The sizes of an array's dimensions; empty for a scalar."""
        return values.dimensions(self.register)

    @property
    def period_ms(self) -> float:  # type: ignore[override]
        """Length of the source's cycle, in ms."""
        return self.feed.block.period_ns / 1e6

    @property
    def writable(self) -> bool:  # type: ignore[override]
        """True if clients may write the register."""
        return self.feed.commands.is_writable(self.register)

    @property
    def comment(self) -> str:
        """The register's comment."""
        return self.register.comment

    def value(self) -> ua.DataValue:
        """Return the present value, with status and source time."""
        return self.feed.data_value(self.register)

    def encoded(self) -> bytes:
        """Return the present value, encoded. It is encoded once for all that read it."""
        return self.feed.encoded(self.register)

    def watch(self) -> Watch:
        """Return the watch of the register's changes."""
        return self.feed.watch(self.register.path, self)

    def all_children(self) -> Iterator[Node]:
        """Yield the properties of the register."""
        yield from self.children.values()
        for name, make in PROPERTIES.items():
            if name != UNIT or self.register.unit:
                yield make(self, name)

    def named(self, name: str) -> Iterator[Node]:
        """Yield the nodes with this name directly below this one."""
        yield from super().named(name)
        if (found := self.property_named(name)) is not None:
            yield found

    def property_named(self, name: str) -> Node | None:
        """Return the property with this name; None if there is none."""
        make = PROPERTIES.get(name)
        return None if make is None or (name == UNIT and not self.register.unit) else make(self, name)


STANDARD: Final = frozenset({"EngineeringUnits", "InputArguments", "OutputArguments"})
"""The properties that the standard defines. Their browse names are in its namespace."""


class Property(VariableNode):
    """A property of another node."""

    type_definition = ua.ObjectIds.PropertyType
    reference = ua.ObjectIds.HasProperty

    def __init__(
        self,
        owner: Node,
        name: str,
        data_type: int,
        get: Callable[[], ua.Variant],
        watch: Callable[[str, Readable], Watch] | None = None,
    ) -> None:
        super().__init__(child_id(owner, name), name, owner)
        if name in STANDARD:
            self.name_space = 0
        self.data_type = ua.NodeId(data_type)
        self._get, self._watch = get, watch

    def value(self) -> ua.DataValue:
        """Return the present value."""
        return ua.DataValue(self._get())

    def watch(self) -> Watch | None:
        """Return the watch of the property's changes; None if its value never changes."""
        return None if self._watch is None else self._watch(str(self.id.Identifier), self)


UNIT: Final = "EngineeringUnits"


def _unit(node: RegisterNode, name: str) -> Property:
    found = values.unit(node.register.unit, node.feed.namespace)
    return Property(node, name, ua.ObjectIds.EUInformation, lambda: ua.Variant(found, _Types.ExtensionObject))


def _provenance(node: RegisterNode, name: str) -> Property:
    def get() -> ua.Variant:
        frame = node.feed.follower.frame
        over = frame is not None and injected(node.feed.block, (node.register,), frame)
        provenance = Provenance.INJECTED if over else Provenance.LIVE if frame is None else frame.provenance
        return ua.Variant(str(provenance), _Types.String)

    return Property(node, name, ua.ObjectIds.String, get, node.feed.watch_detail)


def _injected(node: RegisterNode, name: str) -> Property:
    def get() -> ua.Variant:
        frame = node.feed.follower.frame
        return ua.Variant(frame is not None and injected(node.feed.block, (node.register,), frame), _Types.Boolean)

    return Property(node, name, ua.ObjectIds.Boolean, get, node.feed.watch_detail)


PROPERTIES: Final[dict[str, Callable[[RegisterNode, str], Property]]] = {
    UNIT: _unit,
    "Provenance": _provenance,
    "Injected": _injected,
}
"""The function that creates each property of a register's variable, by the name of the property."""


class Method(Node):
    """A method that clients may call if they have the role ``role``."""

    node_class = ua.NodeClass.Method
    type_definition = 0
    reference = ua.ObjectIds.HasComponent

    def __init__(self, owner: Node, name: str, role: str, comment: str, call: Callable[..., Any]) -> None:
        super().__init__(child_id(owner, name), name, owner)
        self.role, self.call, self._comment = role, call, comment
        self.inputs: list[ua.Argument] = []
        self.outputs: list[ua.Argument] = []

    @property
    def comment(self) -> str:
        """Description of the method."""
        return self._comment

    def all_children(self) -> Iterator[Node]:
        """Yield the properties that describe the arguments."""
        for name in ("InputArguments", "OutputArguments"):
            if (found := self.property_named(name)) is not None:
                yield found

    def named(self, name: str) -> Iterator[Node]:
        """Yield the property with this name."""
        if (found := self.property_named(name)) is not None:
            yield found

    def property_named(self, name: str) -> Node | None:
        """Return the property that describes the input or output arguments; None if there is none with this name."""
        arguments = {"InputArguments": self.inputs, "OutputArguments": self.outputs}.get(name)
        if not arguments:
            return None
        found = Property(
            self, name, ua.ObjectIds.Argument, lambda: ua.Variant(arguments, _Types.ExtensionObject, is_array=True)
        )
        found.sizes = [len(arguments)]
        return found

    def _own(self, attribute: int, roles: Roles) -> ua.Variant | ua.DataValue | None:
        if attribute == _Ids.Executable:
            return ua.Variant(True, _Types.Boolean)
        if attribute == _Ids.UserExecutable:
            return ua.Variant(self.role in roles, _Types.Boolean)
        return None


class SourceNode(Node):
    """The object of a source, with all nodes below it."""

    def __init__(self, root: Node, feed: Feed) -> None:
        source = feed.block.source
        super().__init__(ua.NodeId(source, NAMESPACE), source, root)
        self.feed = feed
        self.by_path: dict[str, Node] = {"": self}
        for register in feed.block.layout.registers:
            self._add(register)
        texts: dict[str, Callable[[], str]] = {
            "Quality": lambda: str(feed.follower.quality),
            "Reason": lambda: feed.follower.reason,
        }
        for name, get in texts.items():
            self.children[f"#{name}"] = Property(
                self, name, ua.ObjectIds.String,
                lambda get=get: ua.Variant(get(), _Types.String), feed.watch_detail,  # type: ignore[misc]
            )  # fmt: skip

    @property
    def comment(self) -> str:
        """The source's connector, and the name of its layout."""
        return f"{self.feed.block.attributes.connector}: {self.feed.block.layout.name}"

    def _add(self, register: Register) -> None:
        head, _, last = register.path.rpartition("/")
        parent = self._folder(head)
        node = RegisterNode(_id(self.name, register.path), decode_segment(last), parent, self.feed, register)
        self.by_path[register.path] = parent.children[last] = node

    def _folder(self, path: str) -> Node:
        found = self.by_path.get(path)
        if found is None:
            head, _, last = path.rpartition("/")
            parent = self._folder(head)
            found = self.by_path[path] = Node(_id(self.name, path), decode_segment(last), parent)
            parent.children[last] = found
        return found


def _id(source: str, path: str) -> ua.NodeId:
    return ua.NodeId(f"{source}/{path}", NAMESPACE)


def child_id(owner: Node, name: str) -> ua.NodeId:
    """Return the node id of a property or method of ``owner``.

    The name follows a ``#``, which no path contains.
    """
    head = "" if owner.id == ROOT else owner.id.Identifier
    return ua.NodeId(f"{head}#{name}", NAMESPACE)


def bad(code: int) -> ua.DataValue:
    """Return a value without content, with this bad status code."""
    return ua.DataValue(StatusCode=ua.StatusCode(code))
