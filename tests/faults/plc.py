"""An emulated S7 PLC, as a process, whose block changes all the time and that keeps the truth about it.

``python -m tests.faults.plc TRUTH PORT SIZE PERIOD_MS``; it prints a line when it listens, and ends with its standard
input.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

from shmio.config.address import Address
from shmio.emulators.s7 import S7Server
from tests.faults.truth import Truth, image, places

NUMBER = 7


def play(server: S7Server, block: bytearray, truth: Truth, period_s: float, stopping: threading.Event) -> None:
    """Run the program until told to stop."""
    of = places(len(block))
    due_s = time.monotonic()
    while True:
        with server.lock:  # nobody reads between what is told and what is
            generation = truth.newest + 1
            truth.record(generation, time.monotonic_ns())
            block[:] = image(generation, of)
        if not server.running:
            server.start()
            print("ready", flush=True)
        due_s = max(due_s + period_s, time.monotonic())
        if stopping.wait(due_s - time.monotonic()):
            return


def main() -> None:
    file, port, size, period_ms = sys.argv[1:]
    block = bytearray(int(size))
    server = S7Server(Address("127.0.0.1", int(port)))
    server.add_block(NUMBER, block)
    stopping = threading.Event()
    truth = Truth(Path(file))
    program = threading.Thread(target=play, args=(server, block, truth, float(period_ms) / 1000, stopping))
    program.start()
    sys.stdin.read()
    stopping.set()
    program.join()
    server.stop()


if __name__ == "__main__":
    main()
