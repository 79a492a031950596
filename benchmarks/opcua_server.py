"""OPC UA: what clients with 1000 monitored items each cost the endpoint, while all values change at 10 Hz.

The server is a process of its own: the endpoint, or for comparison the bare library with the same variables. The
clients, and the writer of the frames, are in this process; the clients count values without decoding them.
``delivered`` is the part of all changes that came. The delay is from the source time of a message's first value until
the client has the message. ``limit`` says which process ran, or waited
for a core, more than 85 % of the time.
"""

from __future__ import annotations

import asyncio
import logging
import os
import struct
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

from asyncua import Client, Server, ua
from asyncua.ua.ua_binary import nodeid_from_binary, struct_from_binary
from common import CpuTime, begin, limits, quantiles, table, waited_s

from shmio.config import OpcUa
from shmio.endpoints.opcua.endpoint import Endpoint
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment

ITEMS = 1000
PERIOD_S = 0.1
CLIENTS = (1, 5, 20)
MOST_BARE = 5
"""With more clients the bare library falls behind so far that they time out."""
EPOCH_TICKS = 116_444_736_000_000_000
"""1970 in the ticks of OPC UA, 100 ns since 1601."""
IN_FLIGHT = 3
"""Requests to publish that each client has under way."""
WRITER = 6
INSTANCE = f"bench-opcua-{os.getpid()}"


def layout() -> Layout:
    registers = tuple(Register(f"part{n // 100}/v{n}", "REAL", (), 4 * n, None, 4, 1) for n in range(ITEMS))
    return Layout("CELL", None, 4 * ITEMS, False, registers)


async def serve(instance: str) -> None:
    with Segment.open(instance, writable=True) as segment:
        slot: Any = SimpleNamespace(writer=WRITER)
        endpoint = Endpoint(segment, slot, OpcUa(listen="127.0.0.1:0"))
        await endpoint.start()
        print(endpoint.server.port, flush=True)
        await asyncio.to_thread(sys.stdin.read)
        await endpoint.stop()


async def serve_bare() -> None:
    server = Server()
    await server.init()
    server.set_endpoint("opc.tcp://127.0.0.1:0/")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    index = await server.register_namespace("urn:bench")
    nodes = []
    for register in layout().registers:
        name = ua.NodeId(f"cell/{register.path}", index)
        nodes.append(await server.nodes.objects.add_variable(name, register.path, 0.0, ua.VariantType.Float))
    async with server:
        assert server.bserver is not None
        print(server.bserver.port, flush=True)
        ended = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
        value = 0.0
        while not ended.done():
            due_s = time.monotonic() + PERIOD_S
            value += 1
            now = datetime.now(UTC)
            for node in nodes:
                variant = ua.Variant(value, ua.VariantType.Float)
                held = ua.DataValue(variant, ua.StatusCode(), SourceTimestamp=now, ServerTimestamp=now)
                await server.write_attribute_value(node.nodeid, held)
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))


class Counter:
    """A client that counts the values that it is sent."""

    def __init__(self, port: int) -> None:
        self.client = Client(f"opc.tcp://127.0.0.1:{port}/", timeout=60)
        self.values = 0
        self.delays_ms: list[float] = []
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        await self.client.connect()
        asked = ua.CreateSubscriptionParameters(PERIOD_S * 1e3, 10_000, 3000, 0, True, 0)
        request: Any = ua.CreateSubscriptionRequest(Parameters=asked)
        data = await self.client.uaclient.protocol.send_request(request)
        made: Any = struct_from_binary(ua.CreateSubscriptionResponse, data)
        items = [
            ua.MonitoredItemCreateRequest(
                ua.ReadValueId(ua.NodeId(f"cell/{register.path}", 2), ua.AttributeIds.Value),
                ua.MonitoringMode.Reporting,
                ua.MonitoringParameters(number, 0.0, None, 1, True),
            )
            for number, register in enumerate(layout().registers)
        ]
        number = made.Parameters.SubscriptionId
        found = await self.client.uaclient.create_monitored_items(
            ua.CreateMonitoredItemsParameters(number, ua.TimestampsToReturn.Both, items)
        )
        assert all(one.StatusCode.is_good() for one in found)
        self._tasks = [asyncio.create_task(self._publish(number)) for _ in range(IN_FLIGHT)]

    async def _publish(self, number: int) -> None:
        acks: list[Any] = []
        while True:
            asked: Any = ua.PublishRequest(Parameters=ua.PublishParameters(acks))
            data = await self.client.uaclient.protocol.send_request(asked, timeout=60)
            nodeid_from_binary(data)
            struct_from_binary(ua.ResponseHeader, data)
            data.read(4)
            (kept,) = struct.unpack("<i", data.read(4))
            data.read(4 * max(0, kept) + 1)
            (sequence,) = struct.unpack("<I", data.read(4))
            data.read(8)
            (count,) = struct.unpack("<i", data.read(4))
            acks = []
            if count > 0:
                nodeid_from_binary(data)
                data.read(5)
                self.values += struct.unpack("<i", data.read(4))[0]
                self.delays_ms.append(1000 * time.time() - first_source_ms(data.read(32)))
                acks = [ua.SubscriptionAcknowledgement(number, sequence)]

    async def stop(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.client.disconnect()


def first_source_ms(data: bytes) -> float:
    """Return the source time of a notification's first value, a Float, in ms since 1970."""
    mask = data[4]
    if mask & 0b101 != 0b101 or data[5] != ua.VariantType.Float.value:
        raise SystemExit(f"the first value is no Float with a source time: {data.hex()}")
    at = 10 + (4 if mask & 2 else 0)
    (ticks,) = struct.unpack_from("<q", data, at)
    return float(ticks - EPOCH_TICKS) / 10_000


async def count(port: int, clients: int, pid: int, duration_s: float) -> list[str]:
    """Return the cells of a row."""
    counters = [Counter(port) for _ in range(clients)]
    for one in counters:
        await one.start()
    await asyncio.sleep(5 * PERIOD_S)  # the first values
    for one in counters:
        one.delays_ms.clear()
    pids = pid, os.getpid()
    before, begun_s = sum(one.values for one in counters), time.perf_counter()
    used, ready_s = [CpuTime.of(one) for one in pids], [waited_s(one) for one in pids]
    await asyncio.sleep(duration_s)
    passed_s = time.perf_counter() - begun_s
    cpu = [CpuTime.of(one).since(then) for one, then in zip(pids, used, strict=True)]
    waited = [100 * (waited_s(one) - then) / passed_s for one, then in zip(pids, ready_s, strict=True)]
    server, own = (100 * (one.user_s + one.system_s) / passed_s for one in cpu)
    rate = (sum(one.values for one in counters) - before) / passed_s
    delays_ms = [delay for one in counters for delay in one.delays_ms]
    for one in counters:
        await one.stop()
    middle_ms, _, late_ms = quantiles(delays_ms)
    shares = rate, 100 * rate * PERIOD_S / (ITEMS * clients), server, own, middle_ms, late_ms
    limit = limits({"server": (server, waited[0]), "clients": (own, waited[1])})
    return [*(f"{value:.0f}" for value in shares), limit]


def measure(bare: bool, clients: int, duration_s: float) -> list[str]:
    block = BlockSpec("cell", layout(), 100_000_000, 10_000_000_000, 1 << 22, Attributes("bench", ()))
    with Segment.create(INSTANCE, [block], [ProcessSpec("cell", "source"), ProcessSpec("opcua", "opcua")]) as segment:
        writer, stop = segment.writer("cell"), threading.Event()

        def publish() -> None:
            cycle, due_s = 0, time.monotonic()
            while not stop.wait(max(0.0, due_s - time.monotonic())):
                due_s += PERIOD_S
                cycle += 1
                image = struct.pack(f">{ITEMS}f", *(0.001 * cycle + place for place in range(ITEMS)))
                writer.publish(image, cycle=cycle, source_ns=time.time_ns())

        publishing = threading.Thread(target=publish)
        publishing.start()
        command = [sys.executable, __file__, "--serve", "bare" if bare else INSTANCE]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
            try:
                assert server.stdout is not None
                port = int(server.stdout.readline())
                return asyncio.run(count(port, clients, server.pid, duration_s))
            finally:
                stop.set()
                publishing.join()
                segment.unlink()
                server.communicate("", timeout=30)


def main() -> None:
    quick = begin("OPC UA: clients with 1000 monitored items each, which all change at 10 Hz")
    rows = []
    for clients in CLIENTS[:1] if quick else CLIENTS:
        for bare in (False, True) if clients <= MOST_BARE else (False,):
            found = measure(bare, clients, 1.0 if quick else 10.0)
            name = "asyncua alone" if bare else "shmio"
            rows.append([f"{clients} client{'s' * (clients > 1)}, {name}", *found])
    titles = ["values/s", "% delivered", "server, % of a core", "clients, % of a core", "delay, ms", "p99", "limit"]
    table(["1000 items each, 10 Hz", *titles], rows)


if __name__ == "__main__":
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    if sys.argv[1:2] == ["--serve"]:
        asyncio.run(serve_bare() if sys.argv[2] == "bare" else serve(sys.argv[2]))
    else:
        main()
