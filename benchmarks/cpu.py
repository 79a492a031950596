"""The CPU use of a whole instance: the A50 cell at 50 Hz, without and with gRPC subscribers.

The figures come from /proc/PID/stat of each process. The emulated controller is counted separately, because a plant
has a real one. The subscribers are counted separately, because they are programs of users.
"""

from __future__ import annotations

import time

from common import Child, CpuTime, begin, keep, table
from instance import Instance, instance

PERIOD_MS = 20
WARM_UP_S = 2.0
REGISTERS = [f"cell/Robot_800/Axs{axis}_Pos" for axis in range(1, 6)]  # a subscriber each; they move in every cycle


def measure(running: Instance, subscribers: Child | None, duration_s: float) -> None:
    """Print one table."""
    pids = running.pids | ({} if subscribers is None else {"subscribers": subscribers.pid})
    time.sleep(WARM_UP_S)
    ring, endpoint = running.segment.blocks["cell"].ring, running.segment.processes.find("grpc")
    frames, messages = ring.head(), endpoint.counters["messages"]
    before, begun_s = {name: CpuTime.of(pid) for name, pid in pids.items()}, time.monotonic()
    time.sleep(duration_s)
    used, taken_s = (
        {name: CpuTime.of(pid).since(before[name]) for name, pid in pids.items()},
        time.monotonic() - begun_s,
    )
    frames, messages = ring.head() - frames, endpoint.counters["messages"] - messages

    def percent(*names: str) -> list[str]:
        user_s, system_s = sum(used[name].user_s for name in names), sum(used[name].system_s for name in names)
        return [f"{100 * value / taken_s:.2f}" for value in (user_s, system_s, user_s + system_s)]

    ours = [name for name in used if name not in {"plc", "subscribers"}]
    rows = [[name, *percent(name)] for name in ours]
    rows.append(["instance", *percent(*ours)])
    rows += [[name, *percent(name)] for name in used if name not in ours]
    count = len(REGISTERS) if subscribers else 0
    keep(f"an instance with {count} subscribers", float(percent(*ours)[-1]), "% of a core", "less")
    table([f"{count} subscribers, % of a core", "user", "system", "sum"], rows)
    print(f"in {taken_s:.1f} s: {frames} frames, {messages} changes encoded")


def main() -> None:
    quick = begin("CPU: an instance with DB201 at 50 Hz")
    duration_s = 3.0 if quick else 20.0
    with instance(PERIOD_MS) as running:
        measure(running, None, duration_s)
        with Child("subscriber.py", running.grpc, *REGISTERS) as subscribers:
            measure(running, subscribers, duration_s)


if __name__ == "__main__":
    main()
