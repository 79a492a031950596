"""What the audit log costs: the latency of commands, and the CPU time of the processes involved.

Instances with and without an audit log take turns. Each has a source without a device, so that nothing but shmio takes
time. A program on the host, and then a client of shmio.v1, write a value again and again.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

from common import CpuTime, begin, quantiles, table
from instance import Instance, started

import shmio

PROCESSES = ("memory", "grpc", "supervisor")
SOURCE = """
[[source]]
name = "memory"
connector = "memory"
layout = "{layout}"
writable = ["**"]
"""
TAGS = '[registers]\nvalue = "DINT"\n'


class Figures:
    """The figures of one way to write, with or without an audit log."""

    def __init__(self) -> None:
        self.taken_ms: list[float] = []
        self.cpu_us: dict[str, list[float]] = defaultdict(list)

    def measure(self, running: Instance, write: Callable[[int], object], count: int) -> None:
        """Write ``count`` values."""
        for value in range(20):
            write(value)
        before = {name: CpuTime.of(running.pids[name]) for name in PROCESSES}
        for value in range(count):
            begun_s = time.perf_counter()
            write(value)
            self.taken_ms.append(1e3 * (time.perf_counter() - begun_s))
        time.sleep(0.3)  # the supervisor reads events in turns
        for name in PROCESSES:
            used = CpuTime.of(running.pids[name]).since(before[name])
            self.cpu_us[name].append(1e6 * (used.user_s + used.system_s) / count)


def main() -> None:
    """Measure."""
    quick = begin("Audit log: a value written until it is confirmed")
    figures: dict[tuple[str, bool], Figures] = defaultdict(Figures)
    for _ in range(1 if quick else 4):
        for audit in (False, True):
            measure(figures, audit, 50 if quick else 1000)
    rows = []
    for (way, audit), found in sorted(figures.items()):
        cuts = quantiles(found.taken_ms)
        cpu = [f"{statistics.median(found.cpu_us[name]):.0f}" for name in PROCESSES]
        rows.append([f"{way}, {'audit log' if audit else 'none'}", *(f"{cut:.3f}" for cut in cuts), *cpu])
    table(["", "median ms", "p90", "p99", *(f"{name} us" for name in PROCESSES)], rows)


def measure(figures: dict[tuple[str, bool], Figures], audit: bool, count: int) -> None:
    """Run an instance, and write to it by both ways."""
    with tempfile.TemporaryDirectory() as folder:
        layout = Path(folder) / "tags.toml"
        layout.write_text(TAGS)
        settings = f"audit = {str(audit).lower()}"
        with started([], more=SOURCE.format(layout=layout), settings=settings) as running:
            with shmio.attach(running.segment.instance, writable=True) as cell:
                figures["a program on the host", audit].measure(
                    running, lambda value: cell.set({"memory/value": value}), count
                )
            with shmio.connect(str(running.grpc)) as remote:
                figures["a client of shmio.v1", audit].measure(
                    running, lambda value: remote.set({"memory/value": value}), count
                )


if __name__ == "__main__":
    main()
