"""A controller for the benchmarks: shmio's emulated S7 server with one data block, in its own process.

The block does not change unless ``--stamp-ms`` is given. Then a program writes the time of CLOCK_MONOTONIC in ns into
its first eight bytes, a LINT. It does so at random intervals around that mean, so that changes fall anywhere in a
client's poll cycle.
"""

from __future__ import annotations

import argparse
import random
import struct
import threading
import time
from collections.abc import Callable

from common import tell, wait_for_parent

from shmio.config.address import Address
from shmio.emulators.s7 import MAX_PDU_SIZE, S7Server, ServerOptions

NUMBER = 201
SIZE = 2180
SEED = 201


def still_block(size: int = SIZE) -> bytes:
    """Return a block whose neighbouring bytes differ."""
    return random.Random(SEED).randbytes(size)


def stamp(server: S7Server, block: bytearray, mean_s: float, wait: Callable[[float], bool]) -> None:
    """Write the time into the block at random intervals until told to stop."""
    intervals = random.Random(SEED)
    while not wait(mean_s * intervals.uniform(0.5, 1.5)):
        with server.lock:
            struct.pack_into(">q", block, 0, time.monotonic_ns())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pdu", type=int, default=MAX_PDU_SIZE, help="largest PDU to grant, in bytes")
    parser.add_argument("--jobs", type=int, default=8, help="most jobs to grant at once")
    parser.add_argument("--size", type=int, default=SIZE, help="size of the block, in bytes")
    parser.add_argument("--stamp-ms", type=float)
    arguments = parser.parse_args()
    server = S7Server(Address("127.0.0.1", 0), options=ServerOptions(arguments.pdu, arguments.jobs))
    block = bytearray(still_block(arguments.size))
    server.add_block(NUMBER, block)
    server.start()
    stopping = threading.Event()
    if arguments.stamp_ms:
        mean_s = arguments.stamp_ms / 1000
        threading.Thread(target=stamp, args=(server, block, mean_s, stopping.wait), daemon=True).start()
    tell(str(server.address))
    wait_for_parent()
    stopping.set()
    server.stop()


if __name__ == "__main__":
    main()
