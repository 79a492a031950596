"""The time from a change in the controller's block to a gRPC client in another process, and where the time goes.

The controller writes CLOCK_MONOTONIC into the block at random times. The block is as long as DB201. Supervisor,
source, endpoint, controller and client are separate processes.
"""

from __future__ import annotations

import time

from common import HERE, Child, begin, keep, quantiles, table
from instance import Polled, started

from shmio.config.address import Address

WARM_UP_S = 1.0


def measure(period_ms: float, mean_change_ms: float, duration_s: float) -> None:
    """Print one table for one poll period."""
    round_trips_us = []
    with (
        Child("plc.py", "--stamp-ms", mean_change_ms) as plc,
        started([Polled("cell", Address.parse(plc.hello), period_ms, HERE / "stamped.db")]) as running,
        Child("subscriber.py", running.grpc, "cell/Stamp", "--stamps") as client,
    ):
        source = running.segment.processes.find("cell")
        time.sleep(WARM_UP_S)
        before, begun_s = source.counters, time.monotonic()
        while time.monotonic() < begun_s + duration_s:
            time.sleep(0.1)
            round_trips_us.append(source.counters["round_trip_us"])
        after = source.counters
        started_ns = running.segment.header.started_ns
        stamps = [stamp for stamp in client.finish()["stamps"][0] if stamp[0] > begun_s * 1e9]
    rows = {
        "change to frame": [(started_ns + clock_ns - changed_ns) / 1e6 for changed_ns, clock_ns, _ in stamps],
        "  of which reading the block": [value_us / 1000 for value_us in round_trips_us],
        "frame to client": [(received_ns - started_ns - clock_ns) / 1e6 for _, clock_ns, received_ns in stamps],
        "change to client": [(received_ns - changed_ns) / 1e6 for changed_ns, _, received_ns in stamps],
    }
    table(
        [f"poll each {period_ms:g} ms, ms", "median", "p90", "p99"],
        [[name, *(f"{value:.2f}" for value in quantiles(values))] for name, values in rows.items()],
    )
    keep(f"poll each {period_ms:g} ms: change to client, median", quantiles(rows["change to client"])[0], "ms", "less")
    polls, overruns = (after[name] - before[name] for name in ("polls", "overruns"))
    print(f"{len(stamps)} changes, {polls} polls, {overruns} overruns")


def main() -> None:
    quick = begin("Latency: change in the controller to gRPC client")
    measure(20, 50, 3 if quick else 30)
    measure(1, 5, 3 if quick else 15)


if __name__ == "__main__":
    main()
