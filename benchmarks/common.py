"""What all benchmarks share: fair rounds, tables with ratios, child processes, a description of the machine."""

from __future__ import annotations

import argparse
import contextlib
import csv
import gc
import itertools
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout

HERE = Path(__file__).parent
ROOT = HERE.parent
DB201 = ROOT / "shmio/cli/a50/db201.db"
"""The reference load: a block of 2,180 bytes with 20 REALs that change."""

HISTORY = ROOT / "docs/reference/benchmark-history.csv"
"""Figures of earlier runs, which the documentation site plots."""

Better = Literal["less", "more"]
Samples = Mapping[str, Sequence[float]]
PATIENCE_S = 20.0
"""The longest time for which a client waits for a value."""


# -- the run -----------------------------------------------------------------------------------------------------------


def begin(description: str) -> bool:
    """Parse the options that all benchmarks have, and print the title and the machine.

    Return whether ``--quick`` was given.
    """
    parser = argparse.ArgumentParser(description=description)
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--quick", action="store_true", help="fewer and shorter rounds, which check only that the benchmark works"
    )
    length.add_argument(
        "--store", action="store_true", help=f"append the most important figures to {HISTORY.relative_to(ROOT)}"
    )
    options = parser.parse_args()
    if options.store:
        _stored_as.extend([time.strftime("%Y-%m-%d"), _commit(parser), Path(sys.argv[0]).stem])
    quick: bool = options.quick
    print(f"# {description}\n{machine()}")
    return quick


_stored_as: list[str] = []
"""With ``--store``: the first columns of the run's figures, which are date, commit and benchmark."""


def _commit(parser: argparse.ArgumentParser) -> str:
    """Return the commit that is measured. It has all changes but those of the history."""
    status = ["git", "status", "--porcelain", "--", ".", f":!{HISTORY.relative_to(ROOT)}"]
    if subprocess.run(status, cwd=ROOT, check=True, capture_output=True).stdout:
        parser.error("--store: commit your changes first, so that the figures have a commit")
    commit = ["git", "rev-parse", "--short=8", "HEAD"]
    return subprocess.run(commit, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def keep(figure: str, value: float, unit: str, better: Better) -> None:
    """Append a figure to the history, with the load of the machine by now, if ``--store`` was given."""
    if _stored_as:
        number = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
        row = [*_stored_as, figure, number, unit, better, f"{os.getloadavg()[0]:.1f}"]
        with HISTORY.open("a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(row)


def machine() -> str:
    """Return a line with everything about the machine that affects the figures."""
    cores = len(os.sched_getaffinity(0))
    load = "/".join(f"{value:.2f}" for value in os.getloadavg())
    system, release, architecture = platform.system(), platform.release(), platform.machine()
    return f"{cores} cores {architecture}, {system} {release}, Python {platform.python_version()}, load {load}"


def db201() -> Layout:
    """Compile the reference load."""
    return compile_sources([Source(DB201.name, DB201.read_bytes())]).layouts[0]


# -- measuring ---------------------------------------------------------------------------------------------------------


def interleave(contenders: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Sample every contender once a round. Each round starts with another one, so that other load affects all alike."""
    names = list(contenders)
    samples: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(rounds):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            samples[name].append(contenders[name]())
    return samples


def median_ratio(values: Sequence[float], others: Sequence[float]) -> float:
    """Return the median of the ratios in each round. The machine's speed changes less within a round."""
    return statistics.median(value / other for value, other in zip(values, others, strict=True))


def per_call_ns(function: Callable[[], object], calls: int) -> Callable[[], float]:
    """Make a sampler of the mean time of one call in ns, over a number of calls, without garbage collection."""

    def sample() -> float:
        turns = range(calls)
        gc.disable()
        begun_ns = time.perf_counter_ns()
        for _ in turns:
            function()
        taken_ns = time.perf_counter_ns() - begun_ns
        gc.enable()
        return taken_ns / calls

    return sample


def per_second(function: Callable[[], object], duration_s: float) -> Callable[[], float]:
    """Make a sampler of the number of calls a second, over a duration."""

    def sample() -> float:
        count = 0
        begun_s = time.perf_counter()
        while (taken_s := time.perf_counter() - begun_s) < duration_s:
            function()
            count += 1
        return count / taken_s

    return sample


def quantiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return median, 90th and 99th percentile."""
    cuts = statistics.quantiles(values, n=100, method="inclusive")
    return cuts[49], cuts[89], cuts[98]


# -- clients of a device -----------------------------------------------------------------------------------------------

Connect = Callable[[ExitStack], Callable[[], object]]
"""Connects a client, and returns a function that gets all of the device's values once. The stack disconnects it."""


def compare_clients(title: str, clients: Mapping[str, Connect], count: int, rounds: int, round_s: float) -> None:
    """Print the values a second and the CPU time a value of clients in this process, which take turns.

    The history keeps shmio's figures relative to the second client's.

    Args:
        title: The title of the table.
        clients: The clients by name. The first one is shmio's.
        count: Number of the device's values.
        rounds: Number of turns of each client, which connects for each of them.
        round_s: Length of a turn in s.

    """
    used: dict[str, list[float]] = {name: [] for name in clients}
    samplers = {name: _turn(connect, count, round_s, used[name]) for name, connect in clients.items()}
    rates = {name: statistics.median(found) for name, found in interleave(samplers, rounds).items()}
    costs = {name: statistics.median(found) for name, found in used.items()}
    ours, peer = list(clients)[:2]
    keep(f"{title}: rate relative to {peer}", rates[ours] / rates[peer], "ratio", "more")
    keep(f"{title}: CPU time relative to {peer}", costs[ours] / costs[peer], "ratio", "less")
    rows = [
        [name, f"{rates[name]:.0f}", f"{costs[name]:.2f}"]
        + (["", ""] if name == ours else [f"{rates[ours] / rates[name]:.2f}", f"{costs[ours] / costs[name]:.2f}"])
        for name in clients
    ]
    table([title, "values/s", "µs of CPU a value", "shmio's rate to it", "shmio's CPU to it"], rows)


def _turn(connect: Connect, count: int, duration_s: float, costs: list[float]) -> Callable[[], float]:
    """Make a sampler of a client's values a second, which adds its CPU time a value, in us, to a list."""

    def sample() -> float:
        with ExitStack() as stack:
            get_all = connect(stack)
            cycles, used_s, begun_s = 0, time.process_time(), time.perf_counter()
            while (taken_s := time.perf_counter() - begun_s) < duration_s:
                get_all()
                cycles += 1
            costs.append(1e6 * (time.process_time() - used_s) / (cycles * count))
        return cycles * count / taken_s

    return sample


def follow(device: Child, newest: Callable[[], object], period_s: float) -> Callable[[], object]:
    """Return a function that lets a device change all its values at once, and waits until a client has the last one.

    The client reads while the device sends, as the process of a source does.

    Args:
        device: A program that gives all values the number that it reads.
        newest: Returns the client's newest number from the last value.
        period_s: Time between two calls of ``newest``.

    """

    def wait(number: int, patience_s: float) -> bool:
        end_s = time.monotonic() + patience_s
        while newest() != number:
            if time.monotonic() > end_s:
                return False
            time.sleep(period_s)
        return True

    numbers = itertools.count()
    end_s = time.monotonic() + PATIENCE_S
    device.ask(-1)
    while not wait(-1, 0.5):  # until the device has found the client
        if time.monotonic() > end_s:
            raise SystemExit("the client does not get the device's values")
        device.ask(-1)

    def change() -> None:
        number = next(numbers)
        device.send(number)
        if not wait(number, PATIENCE_S):
            raise SystemExit("a value of the device is lost")
        device.answer()

    return change


# -- printing ----------------------------------------------------------------------------------------------------------


def report(title: str, unit: str, samples: Samples, ours: str, better: Better, peer: str | None = None) -> None:
    """Print best and median of each contender, and the ratio of its median to the median of ours.

    The history keeps our median, and how many times as fast as ``peer`` we are.
    """
    own = statistics.median(samples[ours])
    keep(f"{title}: {ours}", own, unit, better)
    rows = []
    for name, values in samples.items():
        median = statistics.median(values)
        best, ratio = (min(values), median / own) if better == "less" else (max(values), own / median)
        rows.append([name, f"{best:.0f}", f"{median:.0f}", "" if name == ours else f"{ratio:.2f} times as fast"])
        if name == peer:
            keep(f"{title}: {ours}, times as fast as {peer}", ratio, "ratio", "more")
    table([f"{title}, {unit}", "best", "median", "shmio is"], rows)


def report_spread(title: str, unit: str, samples: Samples, ours: str, digits: int = 1) -> None:
    """Print median, p90 and p99 of each contender's times, and the ratio of its median to the median of ours.

    The history keeps our median.
    """
    own = statistics.median(samples[ours])
    keep(f"{title}: {ours}", own, unit, "less")
    rows = []
    for name, values in samples.items():
        cuts = quantiles(values)
        ratio = "" if name == ours else f"{cuts[0] / own:.2f} times as fast"
        rows.append([name, *(f"{cut:.{digits}f}" for cut in cuts), ratio])
    table([f"{title}, {unit}", "median", "p90", "p99", "shmio is"], rows)


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under titles. The first column is flush left."""
    widths = [max(len(row[place]) for row in [titles, *rows]) for place in range(len(titles))]
    print()
    for row in [titles, *rows]:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        print("  ".join(cells).rstrip())


# -- child processes ---------------------------------------------------------------------------------------------------


class Child:
    """A benchmark script in its own process, so that no two parties share an interpreter lock.

    It prints one JSON line when it is ready, works until its standard input ends, and may then print another line. It
    ends when its parent ends.
    """

    def __init__(self, script: str, *arguments: object, packages: Path | None = None) -> None:
        """Start the script. Packages in the folder ``packages`` take precedence over installed ones."""
        self._script = script
        runner = "node" if script.endswith(".js") else sys.executable
        command = [runner, str(HERE / script), *map(str, arguments)]
        environment = None if packages is None else os.environ | {"PYTHONPATH": str(packages)}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self.pid = self._process.pid
        self.hello: Any = self.answer()

    def answer(self) -> Any:
        """Wait for the child's next line, and return what it says."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self.stop()
            raise SystemExit(f"{self._script} ended with status {self._process.returncode}")
        return json.loads(line)

    def send(self, line: object) -> None:
        """Send a line. The child's :meth:`answer` to it must be awaited before the next one."""
        assert self._process.stdin is not None
        print(line, file=self._process.stdin, flush=True)

    def ask(self, line: object) -> Any:
        """Send a line, and return the JSON answer."""
        self.send(line)
        return self.answer()

    def finish(self) -> Any:
        """Close the child's input, and return the last line that it prints."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        return self.answer()

    def stop(self) -> None:
        """End the child, and wait until it has ended."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def tell(message: object) -> None:
    """Print one JSON line for the parent process."""
    print(json.dumps(message), flush=True)


def wait_for_parent() -> None:
    """Wait until the parent closes our standard input, or dies."""
    sys.stdin.read()


@dataclass(frozen=True)
class CpuTime:
    """The CPU time in s that all threads of a process have used, in steps of 10 ms."""

    user_s: float
    system_s: float

    @classmethod
    def of(cls, pid: int) -> CpuTime:
        """Read fields 14 and 15 of /proc/PID/stat, proc_pid_stat(5)."""
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        tick_s = 1 / os.sysconf("SC_CLK_TCK")
        return cls(int(after_name[11]) * tick_s, int(after_name[12]) * tick_s)

    def since(self, before: CpuTime) -> CpuTime:
        """Return the CPU time used since an earlier reading."""
        return CpuTime(self.user_s - before.user_s, self.system_s - before.system_s)


BUSY = 85.0
"""Percent of its time that a process runs, or waits for a core, from which on it limits a rate."""


def waited_s(pid: int) -> float:
    """Return how long the threads of a process were ready to run without a core, in s (schedstat of proc(5))."""
    files = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(file.read_text().split()[1]) for file in files) / 1e9


def limits(shares: Mapping[str, tuple[float, float]]) -> str:
    """Name the processes that limited a rate.

    Args:
        shares: Percent of the time that each ran, and that it was ready to run without a core.

    """
    found = [
        name + (" (other load)" if ran <= BUSY else "") for name, (ran, waited) in shares.items() if ran + waited > BUSY
    ]
    return " and ".join(found) or "none"
