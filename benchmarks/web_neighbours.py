"""Clients of gRPC and MQTT beside loads of the web page: 500 silent WebSockets, and ten pages with 20 signals.

A source polls a controller at 50 Hz, which writes CLOCK_MONOTONIC into its block. A client of gRPC and a client of MQTT
follow that register: the time from the frame's publication until each has it. *Ratio*: to the same client without a
load. *Overruns* are those of the source. The situations take turns, and all parties are separate processes.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import NamedTuple

from common import HERE, Child, begin, quantiles, table
from instance import Instance, Polled, started
from web_page import PERIOD_MS, SILENT

from shmio.config.address import Address
from shmio.testing.ports import reserved_port

STAMP = "cell/Stamp"
SITUATIONS: dict[str, Sequence[object]] = {
    "alone": (),
    f"{SILENT} silent WebSockets": ("--silent", SILENT),
    "10 pages, 20 signals": ("--pages", 10),
}


class Beside(NamedTuple):
    """Latencies in ms of the clients of two endpoints, and the overruns of their source."""

    grpc: list[float]
    mqtt: list[float]
    overruns: int


def beside(running: Instance, web: Address, broker: Address, load: Sequence[object], duration_s: float) -> Beside:
    """Return the latencies of a gRPC client and an MQTT client, and the overruns, beside a load of the web page."""
    slot = running.segment.processes.find("cell")
    with ExitStack() as stack:
        if load:
            stack.enter_context(Child("web_load.py", web, *load))
        by_grpc = stack.enter_context(Child("subscriber.py", running.grpc, STAMP, "--stamps"))
        by_mqtt = stack.enter_context(Child("mqtt_stamps.py", broker, f"bench/{STAMP}/out"))
        time.sleep(1)
        begun_ns, overruns = time.monotonic_ns(), slot.counters["overruns"]
        time.sleep(duration_s)
        overruns = slot.counters["overruns"] - overruns
        received = by_mqtt.finish()
        stamps = by_grpc.finish()["stamps"][0]
    started_ns = running.segment.header.started_ns
    published_ns = {stamp: started_ns + clock_ns for stamp, clock_ns, _ in stamps}
    return Beside(
        [(at_ns - started_ns - clock_ns) / 1e6 for _, clock_ns, at_ns in stamps if at_ns > begun_ns],
        [(at_ns - published_ns[one]) / 1e6 for one, at_ns in received if at_ns > begun_ns and one in published_ns],
        overruns,
    )


def main() -> None:
    quick = begin("Clients of gRPC and MQTT beside loads of the web page")
    rounds, duration_s = (1, 2.0) if quick else (5, 10.0)
    found: dict[str, list[Beside]] = {name: [] for name in SITUATIONS}
    with (
        Child("plc.py", "--stamp-ms", 5) as plc,
        reserved_port() as web,
        reserved_port() as broker,
        started(
            [Polled("cell", Address.parse(plc.hello), PERIOD_MS, HERE / "stamped.db")],
            more=f'[web]\nlisten = "{web}"\n[mqtt]\nlisten = "{broker}"\nprefix = "bench"\n',
        ) as running,
    ):
        for _ in range(rounds):
            for name, load in SITUATIONS.items():
                found[name].append(beside(running, web, broker, load, duration_s))
    rows = []
    for endpoint in ("grpc", "mqtt"):
        samples = {name: [ms for run in runs for ms in getattr(run, endpoint)] for name, runs in found.items()}
        alone = quantiles(samples["alone"])
        for name, values in samples.items():
            cuts = quantiles(values)
            ratios = ["" if name == "alone" else f"{cut / base:.2f}" for cut, base in zip(cuts, alone, strict=True)]
            overruns = sum(one.overruns for one in found[name])
            rows.append(
                [f"{endpoint}, {name}", f"{cuts[0]:.2f}", ratios[0], f"{cuts[1]:.2f}", ratios[1], f"{cuts[2]:.2f}",
                 ratios[2], str(overruns)]
            )  # fmt: skip
    table(["frame to client, ms", "median", "ratio", "p90", "ratio", "p99", "ratio", "overruns"], rows)


if __name__ == "__main__":
    main()
