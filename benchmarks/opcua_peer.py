"""An OPC UA server as a program: COUNT variables, which all change every PERIOD_MS.

Usage: opcua_peer.py asyncua|shmio COUNT PERIOD_MS

It is made with asyncua, or is shmio's endpoint, for rates that asyncua's server does not reach. It prints its port. A
line on its standard input asks how often it has changed all variables.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import struct
import sys
import threading
import time
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

from asyncua import Server, ua
from common import tell

from shmio.config import OpcUa
from shmio.endpoints.opcua.endpoint import Endpoint
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment


async def serve_asyncua(count: int, period_s: float) -> None:
    server = Server()
    await server.init()
    server.set_endpoint("opc.tcp://127.0.0.1:0/")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    index = await server.register_namespace("urn:bench")
    nodes = []
    for number in range(count):
        if number % 100 == 0:
            folder = await server.nodes.objects.add_folder(ua.NodeId(f"part{number}", index), f"part{number}")
        made = await folder.add_variable(ua.NodeId(f"cell/v{number}", index), f"v{number}", 0.0, ua.VariantType.Float)
        nodes.append(made.nodeid)
    loop, changes = asyncio.get_running_loop(), 0

    async def change() -> None:
        nonlocal changes
        due_s = loop.time()
        while True:
            now = datetime.now(UTC)
            for number, node in enumerate(nodes):
                variant = ua.Variant(float(changes + number), ua.VariantType.Float)
                held = ua.DataValue(variant, ua.StatusCode(), SourceTimestamp=now, ServerTimestamp=now)
                await server.write_attribute_value(node, held)
                if number % 500 == 499:
                    await asyncio.sleep(0)
            changes += 1
            due_s = max(due_s + period_s, loop.time())  # a late change is no reason to hurry
            await asyncio.sleep(due_s - loop.time())

    async with server:
        changing = asyncio.create_task(change())
        assert server.bserver is not None
        tell(server.bserver.port)
        while await asyncio.to_thread(sys.stdin.readline):
            tell(changes)
        changing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await changing


async def serve_shmio(count: int, period_s: float) -> None:
    registers = tuple(Register(f"v{n}", "REAL", (), 4 * n, None, 4, 1) for n in range(count))
    layout = Layout("CELL", None, 4 * count, False, registers)
    block = BlockSpec("cell", layout, round(period_s * 1e9), 10_000_000_000, 1 << 22, Attributes("bench", ()))
    processes = [ProcessSpec("cell", "source"), ProcessSpec("opcua", "opcua")]
    with Segment.create(f"bench-peer-{os.getpid()}", [block], processes) as segment:
        writer, stop, changes = segment.writer("cell"), threading.Event(), 0

        def publish() -> None:
            nonlocal changes
            due_s = time.monotonic()
            while not stop.wait(max(0.0, due_s - time.monotonic())):
                due_s = max(due_s + period_s, time.monotonic())
                image = struct.pack(f">{count}f", *range(changes, changes + count))
                changes += 1
                writer.publish(image, cycle=changes, source_ns=time.time_ns())

        slot: Any = SimpleNamespace(writer=6)
        endpoint = Endpoint(segment, slot, OpcUa(listen="127.0.0.1:0"))
        publishing = threading.Thread(target=publish)
        publishing.start()
        try:
            await endpoint.start()
            tell(endpoint.server.port)
            while await asyncio.to_thread(sys.stdin.readline):
                tell(changes)
            await endpoint.stop()
        finally:
            stop.set()
            publishing.join()
            segment.unlink()


if __name__ == "__main__":
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    serve = serve_shmio if sys.argv[1] == "shmio" else serve_asyncua
    asyncio.run(serve(int(sys.argv[2]), float(sys.argv[3]) / 1000))
