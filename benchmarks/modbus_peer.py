"""A Modbus device as a program: COUNT registers of type REAL from holding register 0 on, whose values do not change.

Usage: modbus_peer.py COUNT

It is shmio's emulator, which answers with pymodbus's server. It prints its port.
"""

from __future__ import annotations

import sys

from common import tell, wait_for_parent

from shmio.emulators.device import Served
from shmio.emulators.modbus import ModbusEmulator
from shmio.layout.tags import place_tags
from shmio.testing.ports import reserved_port


def main() -> None:
    tags = {f"v{n}": {"type": "REAL", "address": f"holding {2 * n}", "initial": n / 2} for n in range(int(sys.argv[1]))}
    with reserved_port() as address:
        emulator = ModbusEmulator([Served(place_tags("bench", tags), {})], "idle", address)
        emulator.start()
        tell(address.port)
        wait_for_parent()
        emulator.stop()


if __name__ == "__main__":
    main()
