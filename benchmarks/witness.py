"""What the machine itself does to a loop: python witness.py LATE_MS CORE.

A process that does nothing but sleep to an absolute schedule, on one core, before all others if the host lets it have
a real-time priority: then only the kernel and a hypervisor can make it late. It tells in the end whether it had that,
and when (CLOCK_MONOTONIC, s) it came ``LATE_MS`` late or more, and by how much: no loop fares better there.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time

LOOKS = 4
"""How often in the time that counts as late: a stall between two looks is seen nearly whole."""


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
