"""An OPC UA server made with asyncua, as a program: COUNT variables, which all change every PERIOD_MS.

It prints its port. A line on its standard input asks how often it has changed all of them. Nobody's code is
measured here: the server is the same for all clients.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sys
from datetime import UTC, datetime

from asyncua import Server, ua
from common import tell


async def main(count: int, period_s: float) -> None:
    server = Server()
    await server.init()
    server.set_endpoint("opc.tcp://127.0.0.1:0/")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    index = await server.register_namespace("urn:bench")
    nodes = []
    for number in range(count):
        if number % 100 == 0:
            folder = await server.nodes.objects.add_folder(ua.NodeId(f"part{number}", index), f"part{number}")
        made = await folder.add_variable(ua.NodeId(f"v{number}", index), f"v{number}", 0.0, ua.VariantType.Float)
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


if __name__ == "__main__":
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    asyncio.run(main(int(sys.argv[1]), float(sys.argv[2]) / 1000))
