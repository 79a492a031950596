"""A subscriber's latency from frame to client: alone, beside one that never reads, and beside 50 that come and go.

Each millisecond, a source polls a controller that writes CLOCK_MONOTONIC into its block at random times. All parties
are separate processes. The situations take turns. The memory is that of the endpoint's process after each situation.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from common import HERE, Child, begin, quantiles, table
from instance import Instance, Polled, started

from shmio.config.address import Address

PATH, STILL = "cell/Stamp", "cell/Rest"
SETTLE_S = 1.0
SITUATIONS: dict[str, Sequence[object]] = {
    "alone": (),
    "one never reads": (PATH, "--unread", 1),
    "50 come and go": (STILL, "--moving", 50),
}


def resident_mb(pid: int) -> float:
    """Return the process's private memory in RAM in MB, proc_pid_status(5)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("RssAnon:")).split()[1]) / 1024


def latencies_ms(running: Instance, arguments: Sequence[object], duration_s: float) -> tuple[list[float], int]:
    """Return a subscriber's latencies in ms beside those of bad_subscribers.py, and how often one of these came."""
    with ExitStack() as stack:
        others = stack.enter_context(Child("bad_subscribers.py", running.grpc, *arguments)) if arguments else None
        client = stack.enter_context(Child("subscriber.py", running.grpc, PATH, "--stamps"))
        time.sleep(SETTLE_S)
        begun_s = time.monotonic()
        time.sleep(duration_s)
        stamps = client.finish()["stamps"][0]
        visits = others.finish()["visits"] if others else 0
    started_ns = running.segment.header.started_ns
    taken = [
        (received_ns - started_ns - clock_ns) / 1e6
        for _, clock_ns, received_ns in stamps
        if received_ns > begun_s * 1e9
    ]
    return taken, visits


def main() -> None:
    quick = begin("Neighbours: how other subscribers affect a subscriber's latency")
    rounds, duration_s = (1, 2.0) if quick else (5, 10.0)
    found: dict[str, list[float]] = {name: [] for name in SITUATIONS}
    visits = dict.fromkeys(SITUATIONS, 0)
    memory_mb: dict[str, list[float]] = {name: [] for name in SITUATIONS}
    with (
        Child("plc.py", "--stamp-ms", 5) as plc,
        started([Polled("cell", Address.parse(plc.hello), 1, HERE / "stamped.db")]) as running,
    ):
        for _ in range(rounds):
            for name, arguments in SITUATIONS.items():
                taken, came = latencies_ms(running, arguments, duration_s)
                found[name] += taken
                visits[name] += came
                memory_mb[name].append(resident_mb(running.pids["grpc"]))
    rows = [
        [
            name,
            *(f"{value:.2f}" for value in quantiles(taken)),
            f"{memory_mb[name][0]:.1f}",
            f"{memory_mb[name][-1]:.1f}",
        ]
        for name, taken in found.items()
    ]
    table(["frame to client, ms", "median", "p90", "p99", "MB at first", "MB at last"], rows)
    print(f"{visits['50 come and go']} visits")


if __name__ == "__main__":
    main()
