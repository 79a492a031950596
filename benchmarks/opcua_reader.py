"""A client of ``opcua_peer.py``, as a program: the connector ``opcua``, or asyncua's own client.

Usage: opcua_reader.py shmio|asyncua poll|subscribe PORT COUNT PERIOD_MS SESSIONS

It prints true when it has the first values. Each line on its standard input is a duration in s: it then prints the
number of values that it got in this time, the time, its CPU time, and the cycles that it was late for. With a
period of 0 it polls as fast as it can.
"""

from __future__ import annotations

import asyncio
import logging
import os
import sys
import time
from collections.abc import Callable
from typing import Any

from asyncua import Client, ua
from common import CpuTime, tell

from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.layout.tags import place_tags


class Counting(OpcUaConnector):
    """The connector, which counts the values that it is given."""

    values = 0

    def _deliver(self, samples: Any) -> None:
        self.values += len(samples)
        super()._deliver(samples)


def paced(step: Callable[[], object], period_s: float, duration_s: float) -> int:
    """Repeat a step; return how many cycles were left out because one took too long."""
    begun_s = time.monotonic()
    tick = late = 0
    while (elapsed_s := time.monotonic() - begun_s) < duration_s:
        step()
        if not period_s:
            continue
        tick += 1
        behind = int((time.monotonic() - begun_s) / period_s) - tick
        if behind > 0:
            tick, late = tick + behind, late + behind
        elapsed_s = time.monotonic() - begun_s
        time.sleep(max(0.0, tick * period_s - elapsed_s))
    return late


def answer(values: int, begun_s: float, before: CpuTime, late: int) -> None:
    used = CpuTime.of(os.getpid()).since(before)
    taken_s = time.monotonic() - begun_s
    tell({"values": values, "s": taken_s, "cpu_s": used.user_s + used.system_s, "late": late})


def shmio(mode: Any, port: int, count: int, period_s: float, sessions: int) -> None:
    tags = {f"part{n // 100}/v{n}": {"type": "REAL", "address": f"ns=2;s=cell/v{n}"} for n in range(count)}
    layout = place_tags("bench", tags).with_statuses()
    every_ms = max(1, round(1000 * period_s))
    options = OpcUaOptions(
        url=f"opc.tcp://127.0.0.1:{port}", mode=mode, timeout=20_000, sampling_ms=0, publishing_ms=every_ms,
        session_items=-(-count // sessions),
    )  # fmt: skip
    connector = Counting(options, layout)
    connector.connect()
    connector.read()
    tell(True)
    for line in sys.stdin:
        counted, before, begun_s = connector.values, CpuTime.of(os.getpid()), time.monotonic()
        late = paced(connector.read, period_s, float(line))
        answer(connector.values - counted, begun_s, before, late)
    connector.close()


class Handler:
    values = 0

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:  # noqa: ARG002
        self.values += 1


async def asyncua(mode: str, port: int, count: int, period_s: float) -> None:
    async with Client(f"opc.tcp://127.0.0.1:{port}/", timeout=20) as client:
        nodes = [client.get_node(ua.NodeId(f"cell/v{n}", 2)) for n in range(count)]
        handler, loop = Handler(), asyncio.get_running_loop()
        if mode == "subscribe":
            made = await client.create_subscription(1000 * period_s, handler)
            for at in range(0, count, 1000):
                await made.subscribe_data_change(nodes[at : at + 1000], sampling_interval=0)
        else:
            await client.read_values(nodes)
        tell(True)
        while line := await asyncio.to_thread(sys.stdin.readline):
            counted, before, begun_s = handler.values, CpuTime.of(os.getpid()), time.monotonic()
            late = tick = 0
            while time.monotonic() - begun_s < float(line):
                if mode == "poll":
                    parts = [nodes[at : at + 1000] for at in range(0, count, 1000)]
                    for found in await asyncio.gather(*map(client.read_values, parts)):
                        handler.values += len(found)
                tick += 1
                behind = int((time.monotonic() - begun_s) / period_s) - tick if period_s else 0
                if behind > 0:
                    tick, late = tick + behind, late + behind
                if period_s:
                    await asyncio.sleep(max(0.0, begun_s + tick * period_s - loop.time()))
            answer(handler.values - counted, begun_s, before, late)


if __name__ == "__main__":
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    who, how, (its_port, items) = sys.argv[1], sys.argv[2], map(int, sys.argv[3:5])
    every_s, parallel = float(sys.argv[5]) / 1000, int(sys.argv[6])
    if who == "shmio":
        shmio(how, its_port, items, every_s, parallel)
    else:
        asyncio.run(asyncua(how, its_port, items, every_s))
