"""Modbus: values a second and CPU of the connector ``modbus``, beside pymodbus's own client on the same device.

The device is a process of its own; the clients take turns in this process, one at a time. All read REALs in requests
of 125 words without a pause. The connector also puts each value with its status into an image. pymodbus's client
returns words; in its second row it also makes REALs of them.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from common import Child, begin, interleave, table
from pymodbus.client import ModbusTcpClient

from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec

OURS, WORDS, REALS = "shmio", "pymodbus, words", "pymodbus, REALs"
MOST_WORDS = 125


def connector(stack: ExitStack, port: int, count: int) -> Callable[[], object]:
    """Connect the connector, and check what it reads."""
    layout = place_tags("bench", {f"v{n}": {"type": "REAL", "address": f"holding {2 * n}"} for n in range(count)})
    layout = layout.with_statuses()
    made = ModbusConnector(ModbusOptions(host="127.0.0.1", port=port), layout)
    made.connect()
    stack.callback(made.close)
    image = made.read()
    if [codec(register, layout.byte_order).decode(image) for register in layout.registers] != values(count):
        raise SystemExit("the connector read other values than the device has")
    return made.read


def library(stack: ExitStack, port: int, count: int, *, reals: bool) -> Callable[[], object]:
    """Connect pymodbus's client, and check what it reads."""
    client = ModbusTcpClient("127.0.0.1", port=port)
    client.connect()  # type: ignore[no-untyped-call]
    stack.callback(client.close)
    parts = [(at, min(MOST_WORDS - 1, 2 * count - at)) for at in range(0, 2 * count, MOST_WORDS - 1)]  # whole REALs

    def read() -> list[Any]:
        found: list[Any] = []
        for at, words in parts:
            registers = client.read_holding_registers(at, count=words, device_id=1).registers
            if reals:
                reals_found: Any = client.convert_from_registers(registers, client.DATATYPE.FLOAT32)
                found += reals_found
            else:
                found += registers
        return found

    if reals and read() != values(count):
        raise SystemExit("pymodbus read other values than the device has")
    return read


def values(count: int) -> list[float]:
    """Return the values of the device."""
    return [n / 2 for n in range(count)]


def sampler(read: Callable[[], object], count: int, duration_s: float, costs: list[float]) -> Callable[[], float]:
    """Make a function that returns a client's values a second, and adds its CPU time for each, in us, to a list."""

    def sample() -> float:
        cycles, used_s, begun_s = 0, time.process_time(), time.perf_counter()
        while (taken_s := time.perf_counter() - begun_s) < duration_s:
            read()
            cycles += 1
        costs.append(1e6 * (time.process_time() - used_s) / (cycles * count))
        return cycles * count / taken_s

    return sample


def compare(count: int, rounds: int, round_s: float) -> None:
    """Print the table for so many registers."""
    with Child("modbus_peer.py", count) as device, ExitStack() as stack:
        reads = {
            OURS: connector(stack, device.hello, count),
            WORDS: library(stack, device.hello, count, reals=False),
            REALS: library(stack, device.hello, count, reals=True),
        }
        used: dict[str, list[float]] = {name: [] for name in reads}
        samplers = {name: sampler(read, count, round_s, used[name]) for name, read in reads.items()}
        rates = {name: statistics.median(found) for name, found in interleave(samplers, rounds).items()}
    costs = {name: statistics.median(found) for name, found in used.items()}
    rows = [
        [name, f"{rates[name]:.0f}", f"{costs[name]:.2f}"]
        + ([""] * 2 if name == OURS else [f"{rates[OURS] / rates[name]:.2f}", f"{costs[OURS] / costs[name]:.2f}"])
        for name in reads
    ]
    table([f"{count} REALs", "values/s", "µs of CPU a value", "shmio's rate to it", "shmio's CPU to it"], rows)


def main() -> None:
    quick = begin("Modbus: values a second of the connector and of pymodbus's client")
    for count in (100, 1000) if quick else (100, 1000, 10_000):
        compare(count, *((1, 0.3) if quick else (5, 2.0)))


if __name__ == "__main__":
    main()
