"""Measures how late the machine itself makes a loop: python witness.py LATE_MS CORE.

The process only sleeps to an absolute schedule, on one core. It has real-time priority if the host allows it: then
only the kernel and a hypervisor can make it late. When it ends, it reports whether it had that priority. It also
reports when (CLOCK_MONOTONIC, s) it woke ``LATE_MS`` late or more, and by how much. No other loop on that core can do
better.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time

LOOKS = 4
"""Number of wake-ups in ``LATE_MS``. A stall is therefore measured to a quarter of that time."""


def main() -> None:
    late_limit_s = float(sys.argv[1]) / 1000
    period_s = late_limit_s / LOOKS
    os.sched_setaffinity(0, {int(sys.argv[2])})
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    except PermissionError:
        first = False
    else:
        first = True
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
        late_s = time.monotonic() - due_s
        if late_s >= late_limit_s:
            late.append((due_s, late_s))
        due_s += late_s // period_s * period_s
    print(json.dumps({"first": first, "late": late}))


if __name__ == "__main__":
    main()
