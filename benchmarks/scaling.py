"""How the cost of an instance grows: with sources, with the size of a block, with readers.

Each row is an instance at 50 Hz. Each source has an emulated controller in its own process. The CPU use of these
processes is reported separately, because a plant has real controllers. *All* is the CPU use of the whole machine; its
maximum is 100 % times the number of cores. *Elsewhere* is the part used by programs other than the benchmark. If no
core is idle, or *elsewhere* is large, the figures measure the machine and not shmio. *Due to frame* is the time from
the moment at which a cycle was due to the publication of its frame: lateness, the read, and waiting for a core.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from common import HERE, Child, CpuTime, begin, quantiles, table
from instance import Instance, Polled, started

from shmio.config.address import Address

PERIOD_MS = 20.0
WARM_UP_S = 1.0
MOST_FRAMES = 8 * 50  # what a ring holds of the time that was measured
SIZE = 2_180
TITLES = (
    "of each source",
    "supervisor, gRPC",
    "controllers",
    "readers",
    "elsewhere",
    "all",
    "due to frame, ms",
    "p99",
    "overruns",
    "segment, MB",
    "missed",
)


@dataclass(frozen=True)
class Load:
    """The number of sources and readers, and the size of a block."""

    sources: int = 1
    size: int = SIZE
    processes: int = 0
    """Number of processes that read the first source."""
    threads: int = 0
    """Number of threads that read the first source, in one further process."""


def block_source(folder: Path, size: int) -> Path:
    """Return the file of a data block of this size, which is stamped.db except for its length."""
    if size == SIZE:
        return HERE / "stamped.db"
    path = folder / f"block{size}.db"
    text = (HERE / "stamped.db").read_text()
    path.write_text(text.replace("0..2171", f"0..{size - 9}"))
    return path


def busy_s() -> float:
    """Return the s that the cores have been busy, summed over all cores, proc_stat(5)."""
    fields = list(map(int, Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]))
    return (sum(fields) - fields[3] - fields[4]) / os.sysconf("SC_CLK_TCK")


class Usage:
    """The CPU use of groups of processes and of the machine, since the object was made."""

    def __init__(self, groups: Mapping[str, Sequence[int]]) -> None:
        self._groups = groups
        self._begun_s, self._busy_s = time.monotonic(), busy_s()
        self._before = {pid: CpuTime.of(pid) for pids in groups.values() for pid in pids}

    def percent(self) -> dict[str, float]:
        """Return the use in percent of one core.

        The keys are the groups, ``elsewhere`` for other programs, and ``all`` for the machine.
        """
        taken_s, found = time.monotonic() - self._begun_s, {}
        whole = 100 * (busy_s() - self._busy_s) / taken_s
        for name, pids in self._groups.items():
            used = [CpuTime.of(pid).since(self._before[pid]) for pid in pids]
            found[name] = 100 * sum(cpu.user_s + cpu.system_s for cpu in used) / taken_s
        return found | {"elsewhere": max(0.0, whole - sum(found.values())), "all": whole}


def delays_ms(running: Instance, names: Sequence[str], count: int) -> list[float]:
    """Return the ms from the due time of a cycle to its frame, for the last frames of all sources."""
    started_ns = running.segment.header.started_ns
    found: list[float] = []
    for name in names:
        block = running.segment.blocks[name]
        head = block.ring.head()
        frames = [block.read(number) for number in range(max(1, head - count + 1), head + 1)]
        found += [
            (frame.publish_ns - started_ns - frame.cycle * block.period_ns) / 1e6
            for frame in frames
            if frame is not None
        ]
    return found


def measure(load: Load, duration_s: float) -> list[str]:
    """Run one instance under this load. Return its row of the table."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        layout = block_source(folder, load.size)
        plcs = [stack.enter_context(Child("plc.py", "--size", load.size)) for _ in range(load.sources)]
        sources = [
            Polled(f"cell{at}", Address.parse(plc.hello), PERIOD_MS, layout) for at, plc in enumerate(plcs, start=1)
        ]
        running = stack.enter_context(started(sources))
        names = [source.name for source in sources]
        target = running.segment.instance, names[0]
        readers = [stack.enter_context(Child("reader.py", *target)) for _ in range(load.processes)]
        if load.threads:
            readers.append(stack.enter_context(Child("reader.py", *target, "--threads", load.threads)))
        slots = [running.segment.processes.find(name) for name in names]
        time.sleep(WARM_UP_S)
        groups = {
            "sources": [running.pids[name] for name in names],
            "others": [pid for name, pid in running.pids.items() if name not in names],
            "controllers": [plc.pid for plc in plcs],
            "readers": [reader.pid for reader in readers],
        }
        overruns = sum(slot.counters["overruns"] for slot in slots)
        usage = Usage(groups)
        time.sleep(duration_s)
        used = usage.percent()
        delays = quantiles(delays_ms(running, names, min(MOST_FRAMES, int(duration_s * 1000 / PERIOD_MS))))
        overruns = sum(slot.counters["overruns"] for slot in slots) - overruns
        size_mb = running.segment.shared.size / 1e6
        missed = sum(reader.finish()["missed"] for reader in readers)
    return [
        f"{used['sources'] / load.sources:.2f}",
        *(f"{used[name]:.2f}" for name in ("others", "controllers", "readers", "elsewhere", "all")),
        *(f"{value:.2f}" for value in (delays[0], delays[2])),
        str(overruns),
        f"{size_mb:.1f}",
        str(missed),
    ]


def measure_all(title: str, loads: Mapping[str, Load], duration_s: float) -> None:
    """Print one table."""
    rows = [[name, *measure(load, duration_s)] for name, load in loads.items()]
    table([f"{title}; CPU in %", *TITLES], rows)


def main() -> None:
    quick = begin("Scaling: sources, block sizes, readers, at 50 Hz")
    if quick:
        measure_all("everything at once", {"2 of each": Load(2, 4096, 2, 2)}, 1.0)
        return
    duration_s = 10.0
    measure_all("sources of 2,180 bytes", {f"{count}": Load(count) for count in (1, 2, 4, 8, 16)}, duration_s)
    of_sizes = {f"{size}": Load(size=size) for size in (SIZE, 8_192, 32_768, 65_536)}
    measure_all("1 source, bytes", of_sizes, duration_s)
    of_readers = {"none": Load()}
    for count in (1, 5, 50):
        of_readers[f"{count} processes"] = Load(processes=count)
        of_readers[f"{count} threads of one"] = Load(threads=count)
    measure_all("1 source of 2,180 bytes, readers", of_readers, duration_s)


if __name__ == "__main__":
    main()
