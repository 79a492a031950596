"""shmio.v1: register updates a second to one Python client, which decodes them to numpy arrays in its own process.

Every register changes with every frame. Frames are published faster than the client can take them. Each frame that
the client receives counts with its number of registers. The client reports how many frames it missed. Source,
endpoint and client are three processes: on a machine with few cores, they share them.
"""

from __future__ import annotations

import json
import statistics
import threading
import time
from typing import Any

from common import Child, CpuTime, begin, keep, table

from shmio.client import Client, Update, connect

WARM_UP_S = 0.3


class Load:
    """A source that publishes frames of so many registers at a rate."""

    def __init__(self, source: Child, hz: float) -> None:
        self._source = source
        self._hz = hz

    def during(self, seconds: float) -> threading.Thread:
        """Publish frames in a thread for so many seconds."""
        line = json.dumps({"hz": self._hz, "seconds": seconds})
        thread = threading.Thread(target=self._source.ask, args=(line,))
        thread.start()
        return thread


def count(update: Update) -> int:
    """Return how many elements of an update came as numpy arrays."""
    return sum(len(values) for _, _, values in update.changes)


def sample(cell: Client, load: Load, pid: int, seconds: float, registers: int, **options: Any) -> dict[str, float]:
    layout = cell.layouts("cell")["cell"]
    elements = updates = missed = 0
    total = 0.0
    with cell.subscribe("cell", **options) as stream:
        next(stream)
        offering = load.during(seconds + 2 * WARM_UP_S)
        begun_s = time.monotonic()
        while time.monotonic() - begun_s < WARM_UP_S:
            next(stream)
        cpu, begun_s = CpuTime.of(pid), time.monotonic()
        while (taken_s := time.monotonic() - begun_s) < seconds:
            update = next(stream)
            updates += 1
            missed += update.missed
            if update.image:
                total += float(layout.array(update.image)["r0"])
                elements += registers
            else:
                elements += count(update)
        used = CpuTime.of(pid).since(cpu)
    offering.join()
    return {
        "elements": elements / taken_s,
        "updates": updates / taken_s,
        "missed": 100 * missed / max(1, missed + updates),
        "cpu": 1e9 * (used.user_s + used.system_s) / max(1, elements),
    }


def measure(registers: int, hz: float, rounds: int, seconds: float) -> None:
    """Print one table for one number of registers."""
    modes: dict[str, dict[str, Any]] = {
        "every frame": {"every_frame": True},
        "latest": {},
        "raw frames, every one": {"every_frame": True, "frames": True},
    }
    samples: dict[str, list[dict[str, float]]] = {name: [] for name in modes}
    with Child("frames.py", registers) as source, connect(source.hello["address"]) as cell:
        for _ in range(rounds):
            for name, options in modes.items():
                load = Load(source, hz)
                samples[name].append(sample(cell, load, source.hello["pid"], seconds, registers, **options))
    rows = []
    for name, found in samples.items():
        median = {key: statistics.median(one[key] for one in found) for key in found[0]}
        keep(f"{registers} registers, {name}", median["elements"], "registers/s", "more")
        rows.append(
            [
                name,
                f"{median['elements']:.0f}",
                f"{median['updates']:.0f}",
                f"{median['missed']:.1f}",
                f"{median['cpu']:.0f}",
            ]
        )
    title = f"{registers} registers, {hz:.0f} frames/s offered"
    table([title, "registers/s", "frames/s", "missed, %", "endpoint's CPU, ns each"], rows)


def main() -> None:
    quick = begin("shmio.v1: register updates a second to one Python client")
    rounds, seconds = (1, 0.3) if quick else (5, 2.0)
    measure(100, 20_000, rounds, seconds)
    measure(1000, 5_000, rounds, seconds)


if __name__ == "__main__":
    main()
