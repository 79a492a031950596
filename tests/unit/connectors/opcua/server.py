"""An OPC UA server made with asyncua, as a program: it takes commands on standard input, a JSON list a line.

Usage: server.py PORT [CERTIFICATE KEY]; with a certificate it has accounts, and an encrypted endpoint alone.
"""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.common.structures104 import new_enum, new_struct, new_struct_field
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.internal_session import InternalSession
from asyncua.server.monitored_item_service import MonitoredItemService
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import struct_from_binary

PASSWORD = "secret password"
CREATE, CREATE_ALL = MonitoredItemService._create_data_change_monitored_item, InternalSession.create_monitored_items
PROCESS = UaProcessor._process_message
BROWSE, READ, SUBSCRIBE = InternalSession.browse, InternalSession.read, InternalSession.create_subscription
WRITE = InternalSession.write


class Accounts:
    """One account with a password, and those whose certificates are trusted."""

    trusted: set[bytes] = set()  # noqa: RUF012

    def get_user(self, _server: Any, username: str = "", password: str = "", certificate: Any = None) -> User | None:
        if not username:
            return User(UserRole.User, name="by certificate") if certificate in self.trusted else None
        return User(UserRole.User, name=username) if (username, password) == ("operator", PASSWORD) else None


class Device:
    """The nodes and what happens to them."""

    written = 0

    def __init__(self, server: Server) -> None:
        self.server = server
        self.counting: asyncio.Task[None] | None = None
        self.types: dict[str, Any] = {}
        self.structures: set[str] = set()

    def node(self, name: str) -> Any:
        return self.server.get_node(ua.NodeId(name, 2))

    async def add(self, name: str, kind: str, value: Any, writable: bool = True, below: str = "Device") -> None:
        """Add a variable below Objects/2:Device, or below another object."""
        parent = self.node(below)
        variant = _variant(kind, value)
        of_type = ua.NodeId(22) if kind == "ExtensionObject" else None
        made = await parent.add_variable(ua.NodeId(name, 2), f"2:{name}", variant, None, of_type)
        if writable:
            await made.set_writable()

    async def define(self, name: str, fields: list[tuple[str, str, str]], union: bool = False) -> None:
        """Define a structure of fields: name, type or another structure, and ``optional``, ``array`` or nothing."""
        made = []
        for one, kind, how in fields:
            known = self.types.get(kind)
            data_type = known if known is not None else ua.VariantType[kind]
            made.append(new_struct_field(one, data_type, array="array" in how, optional="optional" in how))
        node, _ = await new_struct(self.server, 2, name, made, is_union=union)
        self.types[name] = node
        await self.server.load_data_type_definitions()

    async def enumerate(self, name: str, *values: str) -> None:
        """Define an enumeration."""
        self.types[name] = await new_enum(self.server, 2, name, list(values))
        await self.server.load_data_type_definitions()

    async def structure(self, name: str, data_type: str, value: Any) -> None:
        """Add a variable that is a structure, or an array of them, or set its value."""
        made = (
            [_structure(data_type, one) for one in value] if isinstance(value, list) else _structure(data_type, value)
        )
        variant = ua.Variant(made, ua.VariantType.ExtensionObject)
        if name in self.structures:
            await self.node(name).write_value(variant)
            return
        self.structures.add(name)
        of_type = self.types[data_type].nodeid
        await self.node("Device").add_variable(ua.NodeId(name, 2), f"2:{name}", variant, None, of_type)

    async def rename(self, data_type: str, member: str, name: str) -> None:
        """Give a member of a structure another name, in its definition alone."""
        node = self.types[data_type]
        found = await node.read_attribute(ua.AttributeIds.DataTypeDefinition)
        for one in found.Value.Value.Fields:
            one.Name = name if one.Name == member else one.Name
        await node.write_attribute(ua.AttributeIds.DataTypeDefinition, ua.DataValue(found.Value))

    async def allow(self, name: str, writable: bool = True) -> None:
        """Let clients write a variable, or not."""
        await self.node(name).set_writable(writable)

    async def writes(self) -> int:
        """Return how many values clients have written or tried to write."""

        async def counted(session: Any, asked: Any) -> Any:
            Device.written += len(asked.NodesToWrite) if session.external else 0
            return await WRITE(session, asked)

        InternalSession.write = counted
        return Device.written

    async def monitored(self) -> list[int]:
        """Return the number of monitored items of each subscription."""
        subscriptions = self.server.iserver.subscription_service.subscriptions.values()
        return sorted(len(one.monitored_item_srv._monitored_items) for one in subscriptions)

    async def set(self, name: str, kind: str, value: Any, code: int = 0, source_s: float = 0) -> None:
        data = ua.DataValue(_variant(kind, value), ua.StatusCode(code))
        if source_s:
            data.SourceTimestamp = ua.datetime.fromtimestamp(source_s, ua.timezone.utc)
        await self.node(name).write_value(data)

    async def get(self, name: str) -> Any:
        return await self.node(name).read_value()

    async def remove(self, name: str) -> None:
        await self.server.delete_nodes([self.node(name)])

    async def count(self, name: str, size: int, period_s: float) -> None:
        """Count up in all elements of an array."""

        async def run() -> None:
            number = 0
            while True:
                number += 1
                await self.node(name).write_value(ua.Variant([number] * size, ua.VariantType.UInt32))
                await asyncio.sleep(period_s)

        self.counting = asyncio.create_task(run())

    async def state(self, number: int) -> None:
        """Change the server's state."""
        await self.server.get_node(ua.NodeId(2259, 0)).write_value(ua.Variant(number, ua.VariantType.Int32))

    async def limit(self, in_call: int, in_subscription: int, said: bool) -> None:
        """Refuse larger calls, which the operation limits say or not, and more items in a subscription."""

        async def create_one(service: Any, asked: Any) -> Any:
            if len(service._monitored_items) >= in_subscription:
                return ua.MonitoredItemCreateResult(ua.StatusCode(ua.StatusCodes.BadTooManyMonitoredItems))
            return await CREATE(service, asked)

        async def create_some(session: Any, asked: Any) -> Any:
            if len(asked.ItemsToCreate) > in_call:
                raise ServiceError(ua.StatusCodes.BadTooManyOperations)
            return await CREATE_ALL(session, asked)

        async def read_some(session: Any, asked: Any) -> Any:
            if session.external and len(asked.NodesToRead) > in_call:
                raise ServiceError(ua.StatusCodes.BadTooManyOperations)
            return await READ(session, asked)

        MonitoredItemService._create_data_change_monitored_item = create_one
        InternalSession.create_monitored_items = create_some
        InternalSession.read = read_some
        for number in (11705, 11714):
            value = ua.Variant(in_call if said else 0, ua.VariantType.UInt32)
            await self.server.get_node(ua.NodeId(number, 0)).write_value(value)

    async def refuse_subscriptions(self, code: int) -> None:
        """Refuse further subscriptions with a status code; 0: none."""

        async def refuse(*_: Any, **__: Any) -> Any:
            raise ServiceError(code)

        InternalSession.create_subscription = refuse if code else SUBSCRIBE

    async def describe(self, name: str, text: str, unit: str) -> None:
        """Give a variable a description and a unit."""
        node = self.node(name)
        await node.write_attribute(ua.AttributeIds.Description, ua.DataValue(ua.Variant(ua.LocalizedText(text))))
        found = ua.EUInformation("http://www.opcfoundation.org/UA/units/un/cefact", 1, ua.LocalizedText(unit))
        await node.add_property(ua.NodeId(f"{name} unit", 2), "0:EngineeringUnits", found)

    async def group(self, name: str, parent: str) -> None:
        """Add an object below another one."""
        await self.node(parent).add_object(ua.NodeId(name, 2), f"2:{name}")

    async def refer(self, name: str, other: str) -> None:
        """Let a node organize another one, which may contain it."""
        await self.node(name).add_reference(self.node(other), ua.ObjectIds.Organizes, bidirectional=False)

    async def endless(self, kind: str) -> None:
        """Make up what is below Device when it is browsed.

        ``tree``: a million nodes; ``circle``: some nodes that refer to each other without
        end; ``names``: long names.
        """
        self.sent, self.points = 0, dict[bytes, tuple[Any, int]]()
        device = ua.NodeId("Device", 2)

        def made_up(node: ua.NodeId) -> bool:
            return node == device or (node.NamespaceIndex == 2 and isinstance(node.Identifier, int))

        def page(node: ua.NodeId, at: int, most: int) -> ua.BrowseResult:
            parent = 0 if node == device else node.Identifier
            if parent > 1_000_000 and kind == "tree":
                return ua.BrowseResult()
            self.sent += most
            found = []
            for place in range(at, at + most):
                number = place % 200 + 1 if kind == "circle" else 1000 * parent + place + 1
                name = f"{number}" if kind != "names" else f"{number} " + "x" * 5000
                found.append(
                    ua.ReferenceDescription(
                        ua.NodeId(47), True, ua.NodeId(number, 2), ua.QualifiedName(name, 2), ua.LocalizedText(name),
                        ua.NodeClass.Variable if number > 1_000_000 else ua.NodeClass.Object, ua.NodeId(58),
                    )
                )  # fmt: skip
            result = ua.BrowseResult(References=found)
            if at + most < 1000 or kind == "circle":
                result.ContinuationPoint = f"{parent} {at + most}".encode()
                self.points[result.ContinuationPoint] = node, at + most
            return result

        async def browse(session: Any, asked: Any) -> Any:
            found = await BROWSE(session, asked)
            for place, one in enumerate(asked.NodesToBrowse):
                if made_up(one.NodeId):
                    found[place] = page(one.NodeId, 0, min(500, asked.RequestedMaxReferencesPerNode or 500))
            return found

        async def process(processor: Any, typeid: Any, requesthdr: Any, seqhdr: Any, body: Any) -> Any:
            if typeid != ua.NodeId(ua.ObjectIds.BrowseNextRequest_Encoding_DefaultBinary):
                return await PROCESS(processor, typeid, requesthdr, seqhdr, body)
            asked = struct_from_binary(ua.BrowseNextParameters, body)
            points = [self.points.pop(point) for point in asked.ContinuationPoints]
            response = ua.BrowseNextResponse()
            if not asked.ReleaseContinuationPoints:
                response.Parameters.Results = [page(*point, 500) for point in points]
            processor.send_response(requesthdr.RequestHandle, seqhdr, response)
            return True

        InternalSession.browse, UaProcessor._process_message = browse, process

    async def effort(self) -> list[int]:
        """Return how many made up references were sent, and how many continuation points are open."""
        return [self.sent, len(self.points)]

    async def trust(self, certificate: str) -> None:
        """Admit the user with this certificate, in hex."""
        Accounts.trusted.add(bytes.fromhex(certificate))

    async def expire(self) -> None:
        """End all sessions of clients, but not their connections, as if they had timed out."""
        for session in list(self.server.iserver._external_sessions.values()):
            await session.close_session(True)

    async def clients(self) -> int:
        """Return the number of sessions of clients."""
        return len(self.server.iserver._external_sessions)


def _structure(data_type: str, value: Any) -> Any:
    """Make a structure of the values of its fields; ``[name, values]`` is a structure in it."""
    made = getattr(ua, data_type)()
    for name, given in value.items():
        inner = given
        if isinstance(given, list) and given and isinstance(given[0], str) and isinstance(given[-1], dict):
            inner = (
                _structure(given[0], given[1]) if len(given) == 2 else [_structure(given[0], one) for one in given[1:]]
            )
        setattr(made, name, inner)
    return made


def _variant(kind: str, value: Any) -> ua.Variant:
    standard = kind in ("Range", "EUInformation", "AxisInformation")
    variant = ua.VariantType["ExtensionObject" if standard else kind]
    if kind == "ExtensionObject":
        value = ua.ExtensionObject(ua.NodeId("encoding", 2), bytes.fromhex(value))
    if kind == "ByteString":
        value = bytes.fromhex(value)
    if kind in ("LocalizedText", "StatusCode", "XmlElement"):
        value = getattr(ua, kind)(value)
    if kind == "DateTime":
        value = ua.datetime.fromisoformat(value)
    if kind == "Guid":
        value = ua.uuid.UUID(value)
    if standard:
        value = _structure(kind, value)
    return ua.Variant(value, variant, is_array=isinstance(value, list))


def answer(result: Any) -> None:
    sys.stdout.write(json.dumps(result, default=str) + "\n")
    sys.stdout.flush()


async def main(port: str, certificate: str = "", key: str = "") -> None:
    secured = bool(certificate)
    server = Server(user_manager=Accounts() if secured else None)
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}")
    await server.set_application_uri("urn:test:server")
    if secured:
        server.set_security_policy([
            ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt, ua.SecurityPolicyType.Aes256Sha256RsaPss_Sign,
        ])  # fmt: skip
        await server.load_certificate(Path(certificate))
        await server.load_private_key(Path(key))
        server.set_identity_tokens([ua.UserNameIdentityToken, ua.X509IdentityToken])
    else:
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await server.register_namespace("http://test/device")
    await server.nodes.objects.add_object(ua.NodeId("Device", 2), "2:Device")
    device = Device(server)
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    async with server:
        answer("ready")
        while line := await reader.readline():
            name, *given = json.loads(line)
            try:
                answer(await getattr(device, name)(*given))
            except Exception as error:  # noqa: BLE001
                answer(f"failed: {error!r}")
        if device.counting is not None:
            device.counting.cancel()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
