"""The fault test of examples/five-sources: each peer is killed and frozen, and only its own source may notice.

Usage: python -m tests.faults.five_sources [--rounds N] [--report FILE]

It starts the example on free ports in a temporary folder. In each round it kills each peer and brings it back, then
freezes it and lets it continue. It measures when the registers of the peer's source turned bad and when they were
good again, and counts what the other sources noticed: bad frames and skipped cycles.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, NamedTuple

import shmio
from shmio.local.attach import Attachment
from shmio.model.values import Quality
from shmio.testing.cell import Cell, kill, until
from shmio.testing.ports import reserved_port
from tests.faults.pulse import waited_ns

EXAMPLE: Final = Path(__file__).parents[2] / "examples/five-sources"
PORTS: Final = {"10102": "press", "14840": "furnace", "10502": "conveyor", "11883": "broker", "5555": "grpc"}
"""The ports in the example's file, and what listens there."""
DOMAIN: Final = 42
FAULTS: Final = ("kill", "freeze")
COLUMNS: Final = (
    "peer", "fault", "times", "bad after, ms: median", "max", "allowed", "good again, ms: median", "max",
    "others: frames", "bad", "bad without a processor", "skipped cycles", "longest gap, ms",
)  # fmt: skip
PATIENCE_S: Final = 30.0
CALM_S: Final = 0.5
"""How long all sources must be good before a fault."""


class Peer(NamedTuple):
    """A process that a source reads, directly or through a broker."""

    name: str
    source: str
    limit_ms: float
    """How long the source may take to notice that the peer is silent, in addition to two periods."""


@dataclass(frozen=True)
class Sample:
    """What a source published at one moment."""

    publish_ns: int
    cycle: int
    good: bool
    """Whether all of its measured registers were good. A command that nobody has given yet has no value."""


class Watcher(threading.Thread):
    """Follows all frames of a source."""

    def __init__(self, cell: Attachment, source: str) -> None:
        super().__init__(name=f"watch {source}", daemon=True)
        self.source = source
        self.samples: list[Sample] = []
        self._cell = cell
        self._ending = threading.Event()

    def run(self) -> None:
        """Append a sample for each frame until the end."""
        for view in self._cell.stream(self.source, timeout_s=PATIENCE_S):
            statuses = (view.status(one.path) for one in view.layout.registers if not one.writable)
            good = view.frame.quality is Quality.GOOD and all(s is None or s.quality is Quality.GOOD for s in statuses)
            self.samples.append(Sample(view.frame.publish_ns, view.frame.cycle, good))
            if self._ending.is_set():
                return

    def end(self) -> None:
        """Stop at the next frame."""
        self._ending.set()
        self.join()

    def first(self, after_ns: int, *, good: bool) -> int | None:
        """Return when the first such frame after a time was published; None if there is none yet."""
        begin = bisect_right(self.samples, after_ns, key=attrgetter("publish_ns"))
        return next((one.publish_ns for one in self.samples[begin:] if one.good is good), None)

    def between(self, begin_ns: int, end_ns: int) -> list[Sample]:
        """Return the samples of a time."""
        begin, end = (bisect_right(self.samples, at_ns, key=attrgetter("publish_ns")) for at_ns in (begin_ns, end_ns))
        return self.samples[begin:end]


@dataclass
class Result:
    """The results of one kind of fault for one peer."""

    peer: Peer
    fault: str
    limit_ms: float
    bad_ms: list[float] = field(default_factory=list)
    """Times from the fault to the first frame with bad registers."""
    good_ms: list[float] = field(default_factory=list)
    """Times from the end of the fault (a kill: from the kill) until all registers were good."""
    others_bad: int = 0
    """Bad frames of other sources during the faults."""
    others_starved: int = 0
    """Further such frames, of sources whose processes could not run in time, because the host was busy."""
    others_skipped: int = 0
    """Cycles that other sources skipped during the faults."""
    others_frames: int = 0
    others_late_ms: float = 0.0
    """Longest time between two frames of another source."""


class Example:
    """The running example with its devices, and what its sources publish."""

    def __init__(self, folder: Path, instance: str, stack: ExitStack) -> None:
        """Start it; the stack ends it."""
        shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
        ports = {PORTS[number]: stack.enter_context(reserved_port()) for number in PORTS}
        text = (folder / "supervisor.toml").read_text().replace('name = "five-sources"', f'name = "{instance}"')
        text = re.sub(rf"\b({'|'.join(PORTS)})\b", lambda found: str(ports[PORTS[found[0]]].port), text)
        self._domain = 100 + os.getpid() % 100
        text = text.replace(f"domain = {DOMAIN}", f"domain = {self._domain}")
        (folder / "supervisor.toml").write_text(text)
        config = tomllib.loads(text)
        self.periods_ms = {one["name"]: float(one["period_ms"]) for one in config["source"]}
        self.cell = Cell(folder, instance, ports["grpc"])
        self._broker = str(ports["broker"])
        self.devices: dict[str, subprocess.Popen[bytes]] = {}
        stack.callback(self._end_devices)
        for name in ("sensors", "arm"):
            self.start(name)
        stack.callback(self.cell.supervisor, "down")
        self.cell.up()
        attached = stack.enter_context(shmio.attach(instance))
        self.watchers = {name: Watcher(attached, name) for name in self.periods_ms}
        for watcher in self.watchers.values():
            watcher.start()
            stack.callback(watcher.end)
        by_name = {one["name"]: one for one in config["source"]}

        def limit(source: str, key: str) -> float:
            return float(by_name[source][key])

        self.peers = [
            Peer("press-plc", "press", limit("press", "timeout")),
            Peer("furnace-server", "furnace", limit("furnace", "timeout")),
            Peer("conveyor-device", "conveyor", limit("conveyor", "timeout")),
            Peer("broker", "sensors", limit("sensors", "timeout")),
            Peer("sensors", "sensors", limit("sensors", "max_age_ms")),
            Peer("arm", "arm", limit("arm", "max_age")),
        ]

    def start(self, name: str) -> None:
        """Start a device that is no process of the instance."""
        argument = self._broker if name == "sensors" else str(self._domain)
        self.devices[name] = subprocess.Popen(
            [sys.executable, "-W", "error", str(self.cell.folder / "devices" / f"{name}.py"), argument]
        )

    def _end_devices(self) -> None:
        for device in self.devices.values():
            device.send_signal(signal.SIGCONT)
            device.kill()
            device.wait()

    def _pid(self, peer: Peer) -> int:
        device = self.devices.get(peer.name)
        if device is not None:
            return device.pid
        pid = int(self.cell.processes()[peer.name]["pid"])
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()  # mosquitto, of the broker
        return int(children[0]) if children else pid

    def _waited_ns(self, source: str) -> int:
        """Return how long the processes of a source and of its peers have waited for a processor, in ns."""
        pids = [self.cell.processes()[source]["pid"], *(self._pid(one) for one in self.peers if one.source == source)]
        return sum(map(waited_ns, pids))

    def calm(self) -> None:
        """Wait until all sources have been good for a while."""

        def good() -> bool:
            for name, device in self.devices.items():
                assert device.poll() is None, f"the device {name} has ended"
            now_ns = time.monotonic_ns()
            since_ns = now_ns - int(CALM_S * 1e9)
            found = [watcher.between(since_ns, now_ns) for watcher in self.watchers.values()]
            return all(samples and all(one.good for one in samples) for samples in found)

        try:
            until(good, "all sources are good", PATIENCE_S)
        except AssertionError as error:
            found = self.cell.output("shmio", "get", *self.watchers)
            raise AssertionError(f"{error}\n{found}\n{self.cell.logs()}") from None

    def inflict(self, peer: Peer, fault: str, result: Result) -> None:
        """Inflict one fault, end it, and wait until the source has recovered."""
        self.calm()
        own, pid = self.watchers[peer.source], self._pid(peer)
        others = [name for name in self.watchers if name != peer.source]
        waited = {name: self._waited_ns(name) for name in others}
        begin_ns = time.monotonic_ns()
        kill(pid, signal.SIGKILL if fault == "kill" else signal.SIGSTOP)
        until(
            lambda: own.first(begin_ns, good=False) is not None,
            f"{peer.source} is bad after {fault} of {peer.name}",
            PATIENCE_S,
        )
        bad_ns = own.first(begin_ns, good=False)
        assert bad_ns is not None
        ended_ns = begin_ns
        if fault == "freeze":
            ended_ns = time.monotonic_ns()
            kill(pid, signal.SIGCONT)
        elif peer.name in self.devices:
            self.devices[peer.name].wait()
            self.start(peer.name)
        after_ns = max(ended_ns, bad_ns)
        until(lambda: own.first(after_ns, good=True) is not None, f"{peer.source} is good again", PATIENCE_S)
        good_ns = own.first(after_ns, good=True)
        assert good_ns is not None
        result.bad_ms.append((bad_ns - begin_ns) / 1e6)
        result.good_ms.append((good_ns - ended_ns) / 1e6)
        for name in others:
            limit_ms = min(one.limit_ms for one in self.peers if one.source == name)
            starved = (self._waited_ns(name) - waited[name]) / 1e6 > limit_ms / 2
            _add(result, self.watchers[name].between(begin_ns, good_ns), starved=starved)


def _add(result: Result, samples: Sequence[Sample], *, starved: bool) -> None:
    result.others_frames += len(samples)
    bad = sum(not one.good for one in samples)
    if starved:
        result.others_starved += bad
    else:
        result.others_bad += bad
    for before, after in pairwise(samples):
        result.others_skipped += max(0, after.cycle - before.cycle - 1)
        result.others_late_ms = max(result.others_late_ms, (after.publish_ns - before.publish_ns) / 1e6)


@contextmanager
def started(folder: Path, instance: str) -> Iterator[Example]:
    """Run the example in a folder."""
    with ExitStack() as stack:
        yield Example(folder, instance, stack)


def run(example: Example, rounds: int, seed: int, say: Callable[[str], Any]) -> list[Result]:
    """Inflict each fault on each peer, once a round, in random order."""
    results = {
        (peer.name, fault): Result(peer, fault, peer.limit_ms + 2 * example.periods_ms[peer.source])
        for peer in example.peers
        for fault in FAULTS
    }
    chance = random.Random(seed)
    for number in range(rounds):
        order = list(results.values())
        chance.shuffle(order)
        for result in order:
            example.inflict(result.peer, result.fault, result)
        say(f"round {number + 1} of {rounds}: done")
    return list(results.values())


def report(results: Sequence[Result]) -> str:
    """Return the results as a table of Markdown."""
    lines = [
        f"| {' | '.join(COLUMNS)} |",
        "|---" * len(COLUMNS) + "|",
    ]
    lines += [
        f"| {one.peer.name} | {one.fault} | {len(one.bad_ms)} | {statistics.median(one.bad_ms):.0f} "
        f"| {max(one.bad_ms):.0f} | {one.limit_ms:.0f} | {statistics.median(one.good_ms):.0f} "
        f"| {max(one.good_ms):.0f} | {one.others_frames:,} | {one.others_bad} | {one.others_starved} "
        f"| {one.others_skipped} | {one.others_late_ms:.1f} |"
        for one in results
    ]
    return "\n".join(lines)


def main() -> int:
    """Run the faults; return 1 if a source noticed its fault too late, or another source noticed it."""
    parser = argparse.ArgumentParser(prog="five_sources", description="Kill and freeze the peers of five sources.")
    parser.add_argument("--rounds", type=int, default=10, help="how often each peer gets each fault (default: 10)")
    parser.add_argument("--seed", type=int, default=1, help="determines the order of the faults (default: 1)")
    parser.add_argument("--report", type=Path, metavar="FILE", help="file for the table (default: print it)")
    arguments = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="shmio-five-") as folder,
        started(Path(folder), f"five-{os.getpid()}") as example,
    ):
        results = run(example, arguments.rounds, arguments.seed, lambda line: print(line, flush=True))
    text = report(results)
    if arguments.report:
        arguments.report.write_text(text + "\n")
    else:
        print(text)
    wrong = [
        f"{one.fault} of {one.peer.name}: " + what
        for one in results
        for what, found in (
            (f"bad after {max(one.bad_ms):.0f} ms, allowed are {one.limit_ms:.0f}", max(one.bad_ms) > one.limit_ms),
            (f"{one.others_bad} bad frames of other sources", one.others_bad > 0),
        )
        if found
    ]
    print("\n".join(wrong), file=sys.stderr)
    return bool(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
