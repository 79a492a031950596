"""Lets a cell run for long: DB201 at 50 Hz or faster, five gRPC subscribers, a recorder. Does it grow or lose frames?

A separate reader follows every frame: cycles must be consecutive, and quality must stay good. The number of messages
that subscribers received is compared with the number of changes, and the recording with the frames.

Every few seconds, memory and descriptors of each process are read. A process grows if it has more in the second half
of the run than in its second quarter.

On each core, a witness process only sleeps, at the highest priority that it gets. It reports when the machine itself
stalled. Cycles skipped during a stall are counted separately; shmio itself must skip none.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from common import Child, machine, table
from instance import Instance, instance

from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.segment import Block, Quality

REGISTERS = [f"Robot_800/Axs{axis}_Pos" for axis in range(1, 6)]
FIRST_S = 1.0
"""Time in s at the start in which overruns do not count, because all processes are starting."""
SAMPLE_S = 5.0
NEAR_S = 0.1
"""A cycle skipped within so many s after a stall counts as the stall's, because device and network are late, too."""


def stolen_cpu_s() -> float:
    """Return the s in which this machine wanted to run but the hypervisor ran others, proc(5)."""
    steal = Path("/proc/stat").read_text().split("\n", 1)[0].split()[8]
    return int(steal) / os.sysconf("SC_CLK_TCK")


@dataclass
class Follower:
    """A thread's reader, which reads every frame."""

    block: Block
    frames: int = 0
    bad: int = 0
    skipped: int = 0
    skips: list[tuple[float, int]] = field(default_factory=list)
    """For each skip of cycles, the time of the next frame (CLOCK_MONOTONIC, s) and the number of cycles."""
    changes: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REGISTERS, 0))
    stopping: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Follow until told to stop."""
        decoders = {path: codec(find(self.block.layout, path)) for path in REGISTERS}
        cursor, cycle = self.block.cursor(), None
        values: dict[str, object] = {}
        while not self.stopping.is_set():
            frame = cursor.next(0.5)
            if frame is None:
                continue
            self.frames += 1
            self.bad += frame.quality is not Quality.GOOD
            if cycle is not None and frame.cycle - cycle > 1:
                self.skipped += frame.cycle - cycle - 1
                self.skips.append((frame.publish_ns / 1e9, frame.cycle - cycle - 1))
            cycle = frame.cycle
            for path, decoder in decoders.items():
                value = decoder.decode(frame.image)
                self.changes[path] += path in values and values[path] != value
                values[path] = value
        self.missed = cursor.missed


@dataclass(frozen=True)
class Size:
    """The memory and the descriptors of a process."""

    memory_kb: int
    """Its private pages and its share of shared pages (PSS), without the segment."""
    descriptors: int

    @classmethod
    def of(cls, pid: int) -> Size:
        """Read /proc/PID/smaps."""
        memory_kb, ours = 0, False
        for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
            if line.startswith("Pss:"):
                memory_kb += 0 if ours else int(line.split()[1])
            elif line[0] in "0123456789abcdef":
                ours = "/dev/shm/" in line
        return cls(memory_kb, sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--for", dest="duration_s", type=float, default=1800.0, help="seconds (default: half an hour)")
    parser.add_argument("--period-ms", type=int, default=20, help="of the source (default: 20)")
    parser.add_argument("--quick", action="store_true", help="run for 5 s, which checks only that the benchmark works")
    parser.add_argument("--priority", type=int, help="real-time, of the source and its emulated controller")
    arguments = parser.parse_args()
    duration_s = 5.0 if arguments.quick else arguments.duration_s
    rank = f", real-time priority {arguments.priority}" if arguments.priority else ""
    period_ms = arguments.period_ms
    rate_hz = 1000 / period_ms
    print(f"# Soak: DB201 at {rate_hz:g} Hz{rank}, 5 subscribers, a recorder, {duration_s:g} s\n{machine()}")
    with tempfile.TemporaryDirectory() as folder:
        recorder = f'[recorder]\ndirectory = "{folder}"\n'
        with instance(period_ms, more=recorder, priority=arguments.priority) as running:
            problems = soak(running, period_ms, duration_s)
        if arguments.quick and problems:
            print(f"in so short a time, or on a busy machine, no fault: {'; '.join(problems)}")
            problems = []
        problems += recorded(Path(folder))
    for problem in problems:
        print(f"BROKEN: {problem}")
    raise SystemExit(1 if problems else 0)


def soak(running: Instance, period_ms: int, duration_s: float) -> list[str]:
    """Watch the instance for a duration. Return the problems found."""
    stall_ms = period_ms / 2  # a witness that comes so late tells of a stall
    slots = {slot.name: slot for slot in running.segment.processes}
    time.sleep(FIRST_S)
    before = slots["cell"].counters
    follower = Follower(running.segment.blocks["cell"])
    thread = threading.Thread(target=follower.run)
    sizes: dict[str, list[Size]] = {name: [] for name in running.pids}
    paths = [f"cell/{path}" for path in REGISTERS]
    with ExitStack() as stack:
        subscribers = stack.enter_context(Child("subscriber.py", running.grpc, *paths))
        cores = sorted(os.sched_getaffinity(0))
        witnesses = [stack.enter_context(Child("witness.py", stall_ms, core)) for core in cores]
        thread.start()
        begun_s, stolen_before_s = time.monotonic(), stolen_cpu_s()
        end_s = begun_s + duration_s
        while (rest_s := end_s - time.monotonic()) > 0:
            time.sleep(min(SAMPLE_S, rest_s))
            for name, pid in running.pids.items():
                sizes[name].append(Size.of(pid))
        follower.stopping.set()
        thread.join()
        messages = int(subscribers.finish()["messages"])
        seen = [witness.finish() for witness in witnesses]
    stolen_s = stolen_cpu_s() - stolen_before_s
    stalls = [(at_s, late_s) for one in seen for at_s, late_s in one["late"]]
    after = slots["cell"].counters
    rows, problems = [], []
    for name, taken in sizes.items():
        early, late = taken[len(taken) // 4 : len(taken) // 2] or taken, taken[len(taken) // 2 :]
        memory_kb = [statistics.median(size.memory_kb for size in part) for part in (early, late)]
        descriptors = [statistics.median(size.descriptors for size in part) for part in (early, late)]
        rows.append([name, *(f"{value / 1024:.2f}" for value in memory_kb), *(f"{value:.0f}" for value in descriptors)])
        if memory_kb[1] > memory_kb[0] * 1.02 + 256:
            problems.append(f"{name} grew from {memory_kb[0]:.0f} to {memory_kb[1]:.0f} kB")
        if descriptors[1] > descriptors[0]:
            problems.append(f"{name} went from {descriptors[0]:.0f} to {descriptors[1]:.0f} descriptors")
    table(["process", "MB, 2nd quarter", "MB, 2nd half", "descriptors, 2nd quarter", "2nd half"], rows)
    overruns, failures = (after[name] - before[name] for name in ("overruns", "failures"))
    changes = sum(follower.changes.values())
    print(
        f"{follower.frames} frames, {overruns} overruns, {failures} failures, {follower.bad} not good, "
        f"{follower.skipped} cycles skipped, {follower.missed} missed by the reader; {changes} changes, "
        f"{messages} messages received, {slots['grpc'].counters['dropped']} dropped"
    )
    own = 0
    for at_s, count in follower.skips:
        near = [late_s for when_s, late_s in stalls if when_s - stall_ms / 1000 <= at_s <= when_s + late_s + NEAR_S]
        own += 0 if near else count
        why = f"the machine stood still for {max(near) * 1000:.0f} ms" if near else "the machine did not stand still"
        print(f"at {at_s - begun_s:.1f} s: {count} cycles skipped; {why}")
    rank = "before all others" if all(one["first"] for one in seen) else "at the priority of others"
    longest_ms = max((late_s for _, late_s in stalls), default=0) * 1000
    print(
        f"the machine stood still for {stall_ms:g} ms and more {len(stalls)} times, by the witnesses, {rank}; for "
        f"{longest_ms:.0f} ms at most; {own} of {follower.skipped} skipped cycles came without that; the hypervisor "
        f"took {stolen_s:.1f} s of {os.cpu_count()} x {duration_s:.0f} s of the cores"
    )
    for name, value in (
        ("failed polls", failures),
        ("frames that are not good", follower.bad),
        ("cycles skipped while the machine went on", own),
        ("frames missed by the reader", follower.missed),
        ("messages dropped", slots["grpc"].counters["dropped"]),
        ("restarts", sum(slot.supervised.restarts for slot in slots.values())),
    ):
        if value:
            problems.append(f"{value} {name}")
    # The subscribers joined before the follower and left after it: a few frames at each end.
    if not 0 <= messages - changes <= len(REGISTERS) * 5 / (period_ms / 1000):
        problems.append(f"subscribers received {messages} messages for {changes} changes")
    return problems


def recorded(folder: Path) -> list[str]:
    """Read and check the whole recording. Return the problems found."""
    files = sorted(folder.glob("*.mem"))
    problems, frames, size, last = [], 0, 0, 0
    for file, whole, one in zip(files, dump("verify", files), dump("info", files), strict=True):
        problems += [f"{file.name}: {damage}" for damage in whole["damage"]]
        for block in one["blocks"]:
            if missed := block["missed_frames"] + block["missed_events"]:
                problems.append(f"{file.name}: {missed} frames and events missed")
            if last and block["first_frame"] != last + 1:
                problems.append(
                    f"{file.name} begins with frame {block['first_frame']}, the file before it ends with {last}"
                )
            frames, last = frames + block["frames"], block["last_frame"]
        size += one["size"]
        print(f"{one['from']} to {one['to']}: {frames} frames so far, {one['bytes_per_minute'] / 1e6:.2f} MB/min")
    print(f"{frames} frames recorded in {len(files)} files, {size / 1e6:.1f} MB")
    return problems


def dump(verb: str, files: list[Path]) -> list[dict[str, Any]]:
    """Return the JSON output of a verb of ``shmio-dump`` for each file."""
    command = [sys.executable, "-m", "shmio.cli.dump", verb, "--json", *map(str, files)]
    found = json.loads(subprocess.run(command, capture_output=True, check=False).stdout)
    return found if isinstance(found, list) else [found]


if __name__ == "__main__":
    main()
