"""What the machine itself does to a loop: python witness.py PERIOD_MS CORE.

A process that does nothing but sleep to an absolute schedule, on one core. It tells in the end when
(CLOCK_MONOTONIC, s) it came late by half a period or more, and by how much: no loop of that rate fares better there.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time


def main() -> None:
    period_s = float(sys.argv[1]) / 1000
    os.sched_setaffinity(0, {int(sys.argv[2])})
    ended = threading.Event()

    def await_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=await_end).start()
    print("{}", flush=True)
    late: list[tuple[float, float]] = []
    due_s = time.monotonic()
    while not ended.is_set():
        due_s += period_s
        time.sleep(max(0.0, due_s - time.monotonic()))
        if (late_s := time.monotonic() - due_s) >= period_s / 2:
            late.append((due_s, late_s))
            due_s += late_s // period_s * period_s
    print(json.dumps(late))


if __name__ == "__main__":
    main()
