"""An OPC UA server with the nodes of a machine tool, built from the tables of OPC 40501-1.

Usage: umati_server.py PORT. It prints "ready", and ends when its standard input closes.
"""

from __future__ import annotations

import asyncio
import sys
from typing import Any

from asyncua import Server, ua

URIS = (
    "http://opcfoundation.org/UA/DI/",
    "http://opcfoundation.org/UA/Machinery/",
    "http://opcfoundation.org/UA/MachineTool/",
    "http://maker.example/vmc",
)
HAS_ADD_IN = 17604


async def build(server: Server) -> None:
    """Add the machine to the server, below Objects/Machines."""
    device, machinery, tool, own = [await server.register_namespace(uri) for uri in URIS]

    async def value(parent: Any, space: int, name: str, kind: ua.VariantType, content: Any) -> None:
        await parent.add_variable(space, name, ua.Variant(content, kind))

    machines = await server.nodes.objects.add_folder(machinery, "Machines")
    machine = await machines.add_object(own, "VMC")
    identification = await server.nodes.objects.add_object(device, "Identification")
    await machine.add_reference(identification, ua.NodeId(HAS_ADD_IN), forward=True, bidirectional=True)
    await identification.add_property(device, "Manufacturer", ua.LocalizedText("Maker"))
    await identification.add_property(device, "SerialNumber", "4711")

    monitoring = await machine.add_object(tool, "Monitoring")
    whole = await monitoring.add_object(tool, "MachineTool")
    await value(whole, tool, "OperationMode", ua.VariantType.Int32, 1)
    await value(whole, tool, "FeedOverride", ua.VariantType.Double, 95.5)
    await value(whole, tool, "PowerOnDuration", ua.VariantType.UInt32, 1234)
    channel = await monitoring.add_object(own, "Channel1")
    await value(channel, tool, "ChannelMode", ua.VariantType.Int32, 6)
    await value(channel, tool, "FeedOverride", ua.VariantType.Double, 80.0)
    spindle = await monitoring.add_object(own, "Spindle1")
    await value(spindle, tool, "IsRotating", ua.VariantType.Boolean, True)  # and no Override, which is optional

    production = await machine.add_object(tool, "Production")
    program = await production.add_object(tool, "ActiveProgram")
    await program.add_property(tool, "Name", "PART_7.MPF")
    state = await program.add_object(tool, "State")
    await value(state, 0, "CurrentState", ua.VariantType.LocalizedText, ua.LocalizedText("Running"))


async def main(port: str) -> None:
    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await build(server)
    async with server:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
