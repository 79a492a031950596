"""An emulated S7 PLC, as a process, whose block changes all the time and that keeps the truth about it.

``python -m tests.faults.plc TRUTH LANDED PORT SIZE PERIOD_MS``. The program leaves the last two words of the block to
others; what they write there is noted in LANDED, another file of truth, before they are answered. It prints a line
when it listens, and ends with its standard input.
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
WORD = 8
OTHERS = 2 * WORD
"""What the program leaves to others, at the block's end: a word for local writers, one for those by gRPC."""


class Noting:
    """The server's lock, which is held over each job: notes what a job has written before it lets go."""

    def __init__(self, block: bytearray, landed: Truth) -> None:
        self._lock = threading.Lock()
        self._block = block
        self._landed = landed
        self._last = [bytes(WORD)] * 2

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        tail = bytes(self._block[-OTHERS:])
        words = [tail[:WORD], tail[WORD:]]
        for word, last in zip(words, self._last, strict=True):
            if word != last:
                self._landed.land(int.from_bytes(word, "big"), time.monotonic_ns())
        self._last = words
        self._lock.release()


def play(server: S7Server, block: bytearray, truth: Truth, period_s: float, stopping: threading.Event) -> None:
    """Run the program until told to stop."""
    of = places(len(block) - OTHERS)
    due_s = time.monotonic()
    while True:
        with server.lock:  # nobody reads between what is told and what is
            generation = truth.newest + 1
            truth.record(generation, time.monotonic_ns())
            block[:-OTHERS] = image(generation, of)
        if not server.running:
            server.start()
            print("ready", flush=True)
        due_s = max(due_s + period_s, time.monotonic())
        if stopping.wait(due_s - time.monotonic()):
            return


def main() -> None:
    file, landed, port, size, period_ms = sys.argv[1:]
    block = bytearray(int(size))
    server = S7Server(Address("127.0.0.1", int(port)))
    server.lock = server._memory.lock = Noting(block, Truth(Path(landed)))  # type: ignore[assignment]
    server.add_block(NUMBER, block)
    stopping = threading.Event()
    program = threading.Thread(target=play, args=(server, block, Truth(Path(file)), float(period_ms) / 1000, stopping))
    program.start()
    sys.stdin.read()
    stopping.set()
    program.join()
    server.stop()


if __name__ == "__main__":
    main()
