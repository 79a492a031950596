"""An emulated OPC UA server: serves the nodes of a tag table, or of an S7-1500 data block, with asyncua."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from shmio.config.address import Address
from shmio.emulators.cycle import Cycle
from shmio.emulators.device import Served
from shmio.emulators.loop_thread import LoopThread
from shmio.emulators.programs import BUILT_IN, Idle, Program, UserCode, program
from shmio.errors import ConfigError, EndpointError, SnapshotError, ValueRangeError
from shmio.layout.addresses import siemens
from shmio.layout.addresses.opcua import BrowsePath, NodeAddress, parse
from shmio.layout.image import initial_frame
from shmio.layout.model import NUMBERS, Register
from shmio.layout.values import calendar
from shmio.layout.values.codec import codec, flatten, nest
from shmio.wording import cannot_listen

if TYPE_CHECKING:
    from asyncua import Server, ua

MAX_CLIENTS: Final = 16
MAX_NAMESPACE: Final = 100
"""Highest namespace number that the emulator creates."""
_TYPES: Final[Mapping[str, str]] = {
    "BOOL": "Boolean", "BYTE": "Byte", "USINT": "Byte", "SINT": "SByte", "WORD": "UInt16", "UINT": "UInt16",
    "INT": "Int16", "DWORD": "UInt32", "UDINT": "UInt32", "DINT": "Int32", "LWORD": "UInt64", "ULINT": "UInt64",
    "LINT": "Int64", "REAL": "Float", "LREAL": "Double", "TIME": "Int32", "S5TIME": "UInt32", "LTIME": "Int64",
    "TIME_OF_DAY": "UInt32", "LTOD": "UInt64", "STRING": "String", "WSTRING": "String", "CHAR": "String",
    "WCHAR": "String", "DATE": "DateTime", "DATE_AND_TIME": "DateTime", "LDT": "DateTime", "DTL": "DateTime",
}  # fmt: skip
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_DIGITS: Final = {"DATE_AND_TIME": 3, "LDT": 9, "DTL": 9}


class _Variable:
    """A register and its node. Converts values between the two."""

    def __init__(self, register: Register, address: NodeAddress | BrowsePath, byte_order: Any) -> None:
        """Choose the type of the node. Raise ValueError if no type fits the register."""
        base = register.element.base
        if base not in _TYPES:
            raise ValueError(f"the emulator has no nodes for a {register.type}")
        self.register, self.address = register, address
        self._scale = register.scale if base in NUMBERS else None
        self.kind = "Double" if self._scale is not None else _TYPES[base]
        self._base = base
        self.codec = codec(register, byte_order)
        self.node: Any = None

    @property
    def shape(self) -> str:
        """The type of the node, and its dimensions."""
        return f"{self.kind} {self.register.dims}"

    def there(self, frame: bytearray) -> Any:
        """Return the register's value in an image, converted to the node's type."""
        register, value = self.register, self.codec.decode(frame)
        if not register.dims:
            return self._element(value)
        return nest([self._element(one) for one in flatten(value, register.shape, register.path)], register.shape)

    def here(self, value: Any, frame: bytearray) -> None:
        """Store a value of the node in an image. Raise ValueRangeError if the register cannot hold it."""
        register = self.register
        if not register.dims:
            self.codec.encode_into(self._back(value), frame)
            return
        flat = [self._back(one) for one in flatten(value, register.shape, register.path)]
        self.codec.encode_into(nest(flat, register.shape), frame)

    def _element(self, value: Any) -> Any:
        if self._scale is not None:
            return (float(value) - self._scale[1]) / self._scale[0]
        if self.kind == "DateTime":
            ns = calendar.parse_moment(str(value)) or 0
            return _EPOCH + timedelta(microseconds=ns // 1000)
        return value

    def _back(self, value: Any) -> Any:
        if self._scale is not None:
            number = float(value) * self._scale[0] + self._scale[1]
            return number if self._base in ("REAL", "LREAL") else round(number)
        if self.kind == "DateTime":
            ns = (value.replace(tzinfo=UTC) - _EPOCH) // timedelta(microseconds=1) * 1000
            if self._base == "DATE":
                return calendar.format_day(ns // calendar.NS_PER_DAY)
            return calendar.format_moment(ns, _DIGITS[self._base])
        return value


class _Contents(NamedTuple):
    """What an emulator serves: for each layout, its variables and an image; and the program, which has the first."""

    program: Program
    tables: Sequence[Sequence[_Variable]]
    frames: Sequence[bytearray]


class OpcUaEmulator:
    """Runs a program on one layout, and serves its nodes and those of further layouts.

    Clients may write all nodes. You can start an emulator only once.
    """

    def __init__(
        self, served: Sequence[Served], program_name: str, listen: Address, *, code: UserCode = BUILT_IN
    ) -> None:
        """Prepare the emulator.

        Args:
            served: Tag tables, and data blocks with ``nodes = "siemens"``; the program runs on the
                first.
            program_name: The program to run.
            listen: The address to listen on.
            code: Folder and parameters of the program if it is a class of the user.

        Raises:
            ConfigError: There is no such program, the layout does not suit it, or an address is
                wrong.

        """
        self.address = listen
        self._code, self._program_name = code, program_name
        self._contents = self._made(served)
        self._nodes: _Nodes | None = None
        self._loop = LoopThread("opcua-server")
        self._server: Server | None = None
        self.cycle = Cycle(self._contents.program.period_ms / 1000, self._step, f"program-{program_name}")

    def start(self) -> None:
        """Run the first cycle, listen, and continue in threads. This takes some seconds.

        Raises:
            EndpointError: The address is not available.

        """
        self._contents.program.step(0, self._contents.frames[0])
        self._loop.start()
        self._loop.run(self._serve)
        self.cycle.start()

    def stop(self) -> None:
        """Stop the server and the program; return when all threads have ended."""
        self.cycle.stop()
        if self._server is not None:
            self._loop.run(self._server.stop)
        self._loop.stop()

    def change(self, served: Sequence[Served]) -> None:
        """Serve other layouts from now on. Nodes that are served before and after keep their values."""
        contents = self._made(served)
        self._loop.run(self._replace, contents)
        self._contents = contents

    def save(self) -> bytes:
        """Raise SnapshotError, because the server's nodes cannot be saved."""
        raise SnapshotError("the emulator of OPC UA servers does not support snapshots")

    def prepare_restore(self, data: bytes) -> Callable[[], None]:  # noqa: ARG002
        """Raise SnapshotError, because the server's nodes cannot be restored."""
        raise SnapshotError("the emulator of OPC UA servers does not support snapshots")

    def _made(self, served: Sequence[Served]) -> _Contents:
        return _Contents(
            program(self._program_name, served[0].layout, self._code),
            [list(_variables(one)) for one in served],
            [bytearray(initial_frame(one.layout)[0]) for one in served],
        )

    async def _serve(self) -> None:
        from asyncua import Server, ua  # noqa: PLC0415  it needs the extra

        from shmio.emulators.opcua_parts import serve_parts  # noqa: PLC0415  it needs the extra

        logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # the library logs errors of clients
        server = Server()
        await server.init()
        host = f"[{self.address.host}]" if ":" in self.address.host else self.address.host
        server.set_endpoint(f"opc.tcp://{host}:{self.address.port}/")
        server.set_server_name("shmio emulator")
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        server.iserver.max_connections = MAX_CLIENTS
        serve_parts(server)
        self._nodes = _Nodes(server)
        await self._replace(self._contents)
        try:
            await server.start()
        except OSError as error:
            await server.stop()
            raise EndpointError(cannot_listen(self.address, error)) from None
        self._server = server

    async def _replace(self, contents: _Contents) -> None:
        """Delete the nodes that the contents do not have, and create those that do not exist yet."""
        from asyncua import ua  # noqa: PLC0415  it needs the extra

        assert self._nodes is not None  # noqa: S101 - for the type checker
        await self._nodes.keep(variable for variables in contents.tables for variable in variables)
        for variables, frame in zip(contents.tables, contents.frames, strict=True):
            for variable in variables:
                value = ua.Variant(variable.there(frame), getattr(ua.VariantType, variable.kind))
                variable.node = await self._nodes.variable(variable, value)

    def _step(self, time_s: float) -> None:
        if not isinstance(self._contents.program, Idle):
            self._loop.run(self._in_loop, time_s)

    async def _in_loop(self, time_s: float) -> None:
        """Read the nodes, run a cycle, and write the changed nodes. Clients must wait in the meantime."""
        from asyncua import ua  # noqa: PLC0415  it needs the extra

        frame, variables = self._contents.frames[0], self._contents.tables[0]
        for variable in variables:
            with suppress(ValueRangeError):
                variable.here(await variable.node.read_value(), frame)
        before = bytes(frame)
        self._contents.program.step(time_s, frame)
        now = datetime.now(UTC)
        for variable in variables:
            span = slice(variable.register.offset, variable.register.offset + variable.register.size)
            if before[span] != frame[span]:
                value = ua.Variant(variable.there(frame), getattr(ua.VariantType, variable.kind))
                await variable.node.write_value(ua.DataValue(value, SourceTimestamp=now, ServerTimestamp=now))


class _Nodes:
    """Creates the nodes of registers, and the objects and namespaces that they need."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._objects: dict[tuple[tuple[int, str], ...], Any] = {}
        self._known: dict[NodeAddress | BrowsePath, tuple[Any, str]] = {}  # node and type

    async def keep(self, variables: Iterable[_Variable]) -> None:
        """Delete the nodes that no register has, and those whose register has another type or length."""
        wanted: dict[NodeAddress | BrowsePath, str] = {}
        for one in variables:
            wanted.setdefault(one.address, one.shape)  # the first register of a node has made it
        for address, (node, shape) in list(self._known.items()):
            if wanted.get(address) != shape:
                del self._known[address]
                await self._delete(node)

    async def _delete(self, node: Any) -> None:
        """Delete a node. Clients that monitor it get its status at once, which the library forgets to await."""
        from asyncua import ua  # noqa: PLC0415  it needs the extra

        gone = ua.DataValue(None, ua.StatusCode(ua.UInt32(ua.StatusCodes.BadNodeIdUnknown)))
        await self._server.write_attribute_value(node.nodeid, gone)
        space = self._server.iserver.aspace
        for handle in list(space[node.nodeid].attributes[ua.AttributeIds.Value].datachange_callbacks):
            space.delete_datachange_callback(handle)
        await self._server.delete_nodes([node])

    async def variable(self, variable: _Variable, value: ua.Variant) -> Any:
        """Return the node of a register. Registers with the same address share a node."""
        from asyncua import ua  # noqa: PLC0415  it needs the extra

        address = variable.address
        if address in self._known:
            return self._known[address][0]
        if isinstance(address, BrowsePath):
            *steps, (number, name) = address.steps
            await self._namespace(number)
            parent = await self._object(tuple(steps))
            node = await parent.add_variable(ua.NodeId(NamespaceIndex=number), ua.QualifiedName(name, number), value)
        else:
            number = await self._namespace(address.namespace)
            name = ua.QualifiedName(str(variable.register.path), number)
            objects = self._server.nodes.objects
            node = await objects.add_variable(ua.NodeId(address.identifier, number), name, value)
        await node.set_writable()
        now = datetime.now(UTC)
        await node.write_value(ua.DataValue(value, SourceTimestamp=now, ServerTimestamp=now))
        self._known[address] = node, variable.shape
        return node

    async def _object(self, steps: tuple[tuple[int, str], ...]) -> Any:
        """Return the object at a browse path. Create missing objects."""
        from asyncua import ua  # noqa: PLC0415  it needs the extra

        if not steps:
            return self._server.nodes.root
        if steps not in self._objects:
            parent, (number, name) = await self._object(steps[:-1]), steps[-1]
            await self._namespace(number)
            try:
                found = await parent.get_child([ua.QualifiedName(name, number)])
            except ua.uaerrors.BadNoMatch:
                found = await parent.add_object(ua.NodeId(NamespaceIndex=number), ua.QualifiedName(name, number))
            self._objects[steps] = found
        return self._objects[steps]

    async def _namespace(self, wanted: int | str) -> int:
        """Return the number of a namespace. Create the namespace if it is missing."""
        if isinstance(wanted, str):
            return int(await self._server.register_namespace(wanted))
        known = await self._server.get_namespace_array()
        for number in range(len(known), wanted + 1):
            await self._server.register_namespace(f"urn:shmio:emulator:{number}")
        return wanted


def _variables(served: Served) -> Iterator[_Variable]:
    layout = served.layout
    for register in layout.registers:
        try:
            if served.options.get("nodes") == "siemens" and not register.address:
                address: NodeAddress | BrowsePath = siemens.node_address(layout, register)
            else:
                address = parse(register.address)
            if isinstance(address, NodeAddress) and isinstance(address.namespace, int):
                if address.namespace == 0:
                    raise ValueError(f"{register.address!r}: namespace 0 has only the nodes of the standard")
                if address.namespace > MAX_NAMESPACE:
                    raise ValueError(f"{register.address!r}: the emulator has namespaces up to {MAX_NAMESPACE}")
            yield _Variable(register, address, layout.byte_order)
        except ValueError as error:
            raise ConfigError(f"layout: {register.path}: {error}") from None
