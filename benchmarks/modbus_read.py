"""Modbus: values a second and CPU of the connector ``modbus``, beside pymodbus's own client on the same device.

The device is a process of its own; the clients take turns in this process, one at a time. All read REALs in requests
of 125 words without a pause. The connector also puts each value with its status into an image. pymodbus's client
returns words; in its second row it also makes REALs of them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from common import Child, Connect, begin, compare_clients
from pymodbus.client import ModbusTcpClient

from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec

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


def compare(count: int, rounds: int, round_s: float) -> None:
    """Print the table for so many registers."""
    with Child("modbus_peer.py", count) as device:
        clients: dict[str, Connect] = {
            "shmio": lambda stack: connector(stack, device.hello, count),
            "pymodbus, words": lambda stack: library(stack, device.hello, count, reals=False),
            "pymodbus, REALs": lambda stack: library(stack, device.hello, count, reals=True),
        }
        compare_clients(f"{count} REALs", clients, count, rounds, round_s)


def main() -> None:
    quick = begin("Modbus: values a second of the connector and of pymodbus's client")
    for count in (100, 1000) if quick else (100, 1000, 10_000):
        compare(count, *((1, 0.3) if quick else (5, 2.0)))


if __name__ == "__main__":
    main()
