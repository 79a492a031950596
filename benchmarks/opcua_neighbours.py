"""OPC UA: what the heaviest requests of one client cost another one.

A client reads one register 25 times a second and subscribes to it, while another client loads the endpoint as heavily
as its limits allow. Each is a process of its own. ``read`` is the round trip of a Read, ``change`` the time from the
source time of a value until the subscriber has it, and ``beat`` the longest time without a heartbeat.
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
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any, Final

from asyncua import Client, ua
from asyncua.ua.ua_binary import nodeid_from_binary, struct_from_binary
from common import begin, keep, quantiles, table

from shmio.config import OpcUa
from shmio.endpoints.opcua.endpoint import Endpoint
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from shmio.worker import BEAT_S

ELEMENTS: Final = 2_000
PERIOD_S: Final = 0.02
LOOK_S: Final = 0.04
INSTANCE: Final = f"bench-neighbours-{os.getpid()}"
WRITER: Final = 6
IN_FLIGHT: Final = 10


def layout() -> Layout:
    size = 4 * ELEMENTS
    arrays = [
        Register(name, "REAL", ((0, ELEMENTS - 1),), place * size, None, size, ELEMENTS)
        for place, name in enumerate("ab")
    ]
    return Layout("CELL", None, 2 * size + 4, False, (*arrays, Register("tick", "REAL", (), 2 * size, None, 4, 1)))


async def serve(instance: str) -> None:
    with Segment.open(instance, writable=True) as segment:
        slot: Any = SimpleNamespace(writer=WRITER)
        endpoint = Endpoint(segment, slot, OpcUa(listen="127.0.0.1:0"))
        await endpoint.start()
        print(endpoint.server.port, flush=True)
        over = asyncio.create_task(asyncio.to_thread(sys.stdin.readline))
        longest_s, last_s = 0.0, time.monotonic()
        while not over.done():  # as the process of the endpoint gives its heartbeats
            await asyncio.wait((over,), timeout=BEAT_S)
            now_s = time.monotonic()
            longest_s, last_s = max(longest_s, now_s - last_s), now_s
        print(longest_s, flush=True)
        await endpoint.stop()


# -- the heavy client --------------------------------------------------------------------------------------------------


def value_of(path: str, index_range: str | None = None) -> ua.ReadValueId:
    return ua.ReadValueId(ua.NodeId(f"cell/{path}", 2), ua.AttributeIds.Value, index_range)


async def subscribe(client: Client, targets: list[ua.ReadValueId], queue: int = 1) -> None:
    asked = ua.CreateSubscriptionParameters(20.0, 10_000, 3000, 0, True, 0)
    data = await client.uaclient.protocol.send_request(ua.CreateSubscriptionRequest(Parameters=asked), timeout=120)
    number = struct_from_binary(ua.CreateSubscriptionResponse, data).Parameters.SubscriptionId
    for at in range(0, len(targets), 1000):
        items = [
            ua.MonitoredItemCreateRequest(
                target, ua.MonitoringMode.Reporting, ua.MonitoringParameters(place, 0.0, None, queue, True)
            )
            for place, target in enumerate(targets[at : at + 1000])
        ]
        params = ua.CreateMonitoredItemsParameters(number, ua.TimestampsToReturn.Both, items)
        await client.uaclient.create_monitored_items(params)


async def publish(client: Client) -> None:
    acks: list[Any] = []
    while True:
        request = ua.PublishRequest(Parameters=ua.PublishParameters(acks))
        data = await client.uaclient.protocol.send_request(request, timeout=120)
        nodeid_from_binary(data)
        struct_from_binary(ua.ResponseHeader, data)
        number, kept = struct.unpack("<Ii", data.read(8))
        data.read(4 * max(0, kept) + 1)
        acks = [ua.SubscriptionAcknowledgement(number, struct.unpack("<I", data.read(4))[0])]


async def monitor(client: Client, targets: list[ua.ReadValueId], queue: int = 1, subscriptions: int = 1) -> None:
    for _ in range(subscriptions):
        await subscribe(client, targets, queue)
    await asyncio.gather(*(publish(client) for _ in range(IN_FLIGHT)))


async def repeat(client: Client, request: Any) -> None:
    async def send() -> None:
        while True:
            await client.uaclient.protocol.send_request(request, timeout=120)

    await asyncio.gather(*(send() for _ in range(4)))


def elements(number: int) -> list[ua.ReadValueId]:
    return [value_of(f"{'ab'[place % 2]}/{place // 2}") for place in range(number)]


def arrays(number: int) -> list[ua.ReadValueId]:
    return [value_of("ab"[place % 2]) for place in range(number)]


def reading(targets: list[ua.ReadValueId]) -> Any:
    return ua.ReadRequest(Parameters=ua.ReadParameters(0, ua.TimestampsToReturn.Both, targets))


def browsing() -> Any:
    everything = ua.BrowseDescription(ua.NodeId(2253), ua.BrowseDirection.Both, ua.NodeId(), True, 0, 63)
    return ua.BrowseRequest(Parameters=ua.BrowseParameters(NodesToBrowse=[everything] * 1000))


def following() -> Any:
    step = ua.RelativePathElement(ua.NodeId(33), False, True, ua.QualifiedName("Server", 0))
    back = ua.RelativePathElement(ua.NodeId(33), True, True, ua.QualifiedName("Objects", 0))
    path = ua.BrowsePath(ua.NodeId(85), ua.RelativePath([step, back] * 5))
    return ua.TranslateBrowsePathsToNodeIdsRequest(Parameters=ua.TranslateBrowsePathsToNodeIdsParameters([path] * 1000))


LOADS: Final[dict[str, Callable[[Client], Awaitable[None]]]] = {
    "1,000 items on elements": lambda client: monitor(client, elements(1000)),
    "1,000 items on two arrays": lambda client: monitor(client, arrays(1000)),
    "4,000 items on elements": lambda client: monitor(client, elements(4000)),
    "4,000 items on two arrays": lambda client: monitor(client, arrays(4000)),
    "20 subscriptions, 1,000 items each, queues": lambda client: monitor(client, elements(1000), 100, 20),
    "Read, 10,000 elements": lambda client: repeat(client, reading(elements(10_000))),
    "Read, two arrays, 500 times": lambda client: repeat(client, reading(arrays(500))),
    "Browse, 1,000 nodes": lambda client: repeat(client, browsing()),
    "1,000 browse paths": lambda client: repeat(client, following()),
}
"""What the heavy client does, by name."""


async def load(port: int, name: str) -> None:
    client = Client(f"opc.tcp://127.0.0.1:{port}/", timeout=120, watchdog_intervall=1000.0)
    await client.connect()
    print("ready", flush=True)
    await LOADS[name](client)


# -- the other client --------------------------------------------------------------------------------------------------


class Neighbour:
    """Measures the delay of its Reads, and of the changes that it subscribes to."""

    def __init__(self, port: int) -> None:
        self._client = Client(f"opc.tcp://127.0.0.1:{port}/", timeout=20)
        self.reads_ms: list[float] = []
        self.changes_ms: list[float] = []

    def datachange_notification(self, _node: Any, _value: Any, data: Any) -> None:
        source = data.monitored_item.Value.SourceTimestamp
        if source is not None:
            self.changes_ms.append(1000 * (time.time() - source.timestamp()))

    async def measure(self, duration_s: float, begin_load: Callable[[], object]) -> None:
        """Measure for a time beside a load.

        Raises:
            Exception: The client has lost its session.
        """
        async with self._client as client:
            node = client.get_node(ua.NodeId("cell/tick", 2))
            await (await client.create_subscription(50, self)).subscribe_data_change(node)
            await asyncio.to_thread(begin_load)
            await asyncio.sleep(1)
            self.changes_ms.clear()
            end_s = time.perf_counter() + duration_s
            while (begun_s := time.perf_counter()) < end_s:
                await node.read_value()
                self.reads_ms.append(1000 * (time.perf_counter() - begun_s))
                await asyncio.sleep(max(0.0, LOOK_S - (time.perf_counter() - begun_s)))


def measure(name: str | None, duration_s: float) -> list[str]:
    """Return the cells of a row."""
    block = BlockSpec("cell", layout(), 20_000_000, 10_000_000_000, 1 << 23, Attributes("bench", ()))
    with Segment.create(INSTANCE, [block], [ProcessSpec("cell", "source"), ProcessSpec("opcua", "opcua")]) as segment:
        writer, stop = segment.writer("cell"), threading.Event()

        def write() -> None:
            cycle, due_s = 0, time.monotonic()
            while not stop.wait(max(0.0, due_s - time.monotonic())):
                due_s += PERIOD_S
                cycle += 1
                image = struct.pack(f">{2 * ELEMENTS + 1}f", *(cycle + place for place in range(2 * ELEMENTS + 1)))
                writer.publish(image, cycle=cycle, source_ns=time.time_ns())

        writing = threading.Thread(target=write)
        writing.start()
        command = [sys.executable, __file__]
        server = subprocess.Popen([*command, "--serve", INSTANCE], stdin=-1, stdout=-1, text=True)
        heavy: list[subprocess.Popen[str]] = []
        try:
            assert server.stdout is not None
            port = int(server.stdout.readline())

            def begin_load() -> None:
                if name is not None:
                    heavy.append(subprocess.Popen([*command, "--load", str(port), name], stdout=-1, text=True))
                    heavy[0].stdout.readline()  # type: ignore[union-attr]

            neighbour = Neighbour(port)
            lost = False
            try:
                asyncio.run(neighbour.measure(duration_s, begin_load))
            except Exception:  # noqa: BLE001  the figures so far, and that the session was lost
                lost = True
            for one in heavy:
                one.kill()
                one.wait()
            out, _ = server.communicate("\n", timeout=120)
            reads, changes = (quantiles(one or [float("nan")]) for one in (neighbour.reads_ms, neighbour.changes_ms))
            keep(f"read beside {name or 'nothing'}", reads[0], "ms", "less")
            shown = [reads[0], reads[2], changes[0], changes[2], float(out.split()[-1])]
            return [*(f"{one:.1f}" for one in shown), "yes" if lost else "no"]
        finally:
            stop.set()
            writing.join()
            server.kill()
            server.wait()
            segment.unlink()


def main() -> None:
    quick = begin("OPC UA: what the heaviest requests of one client cost another one")
    rows = [[name or "nothing", *measure(name, 1.0 if quick else 20.0)] for name in [None, *LOADS]]
    titles = ["read, ms", "p99", "change, ms", "p99", "longest without a heartbeat, s", "lost its session"]
    table(["the other client does", *titles], rows)


if __name__ == "__main__":
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    if sys.argv[1:2] == ["--serve"]:
        asyncio.run(serve(sys.argv[2]))
    elif sys.argv[1:2] == ["--load"]:
        asyncio.run(load(int(sys.argv[2]), sys.argv[3]))
    else:
        main()
