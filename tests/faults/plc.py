"""An emulated S7 PLC in a separate process. Its block changes all the time; it records the truth.

``python -m tests.faults.plc TRUTH LANDED GUARDED PORT SIZE PERIOD_MS``. The program does not write
the last six words of the block. What others write to the first two of them is recorded in LANDED,
and to the fourth in GUARDED, before the write is answered. Both are files like TRUTH. The process
prints a line when it listens, and ends when its standard input ends.
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
OTHERS = 6 * WORD
"""Size of the last words of the block, which the program does not write.

In order:

- ``command``: for local writers.
- ``remote``: for writers by gRPC.
- ``shown``: never written; clients inject over ``/out``.
- ``guarded``: written; clients inject over ``/in``.
- ``declared``: never written; only declared injections.
- ``chained``: never written; a chain of a declared injection and those of clients.
"""
SHOWN_AT = 2 * WORD
"""Offset of ``shown`` among them."""
DECLARED_AT = 4 * WORD
CHAINED_AT = 5 * WORD


class Noting:
    """The server's lock for each job. Before its release it records what the job has written."""

    def __init__(self, block: bytearray, landed: Truth, guarded: Truth) -> None:
        self._lock = threading.Lock()
        self._block = block
        self._notes = (landed, landed, None, guarded, None, None)
        self._last = [bytes(WORD)] * len(self._notes)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        tail = bytes(self._block[-OTHERS:])
        words = [tail[at : at + WORD] for at in range(0, OTHERS, WORD)]
        for note, word, last in zip(self._notes, words, self._last, strict=True):
            if note is not None and word != last:
                note.land(int.from_bytes(word, "big"), time.monotonic_ns())
        self._last = words
        self._lock.release()


def play(server: S7Server, block: bytearray, truth: Truth, period_s: float, stopping: threading.Event) -> None:
    """Run the PLC's program until ``stopping`` is set."""
    of = places(len(block) - OTHERS)
    due_s = time.monotonic()
    while True:
        with server.lock:  # no client reads between the record and the change
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
    file, landed, guarded, port, size, period_ms = sys.argv[1:]
    block = bytearray(int(size))
    server = S7Server(Address("127.0.0.1", int(port)))
    noting = Noting(block, Truth(Path(landed)), Truth(Path(guarded)))
    server.lock = server._memory.lock = noting  # type: ignore[assignment]
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
