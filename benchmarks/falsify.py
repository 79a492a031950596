"""Trials a second of shmio-campaign falsify, alone and with a farm, and how many of them the strategies need.

The campaign is that of examples/falsify, whose interlock fails if two signals come within 40 ms. Speed is measured
with the command itself, without shrinking. The strategies are compared with the model of the gate alone, driven by the
same signals: a trial is checked to have the same robustness as in the laboratory.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Final, cast

from common import ROOT, begin, table

from shmio.config.campaign import CampaignFile
from shmio.config.ranges import Point
from shmio.falsification.search import SEARCHES, SearchName, begin_search
from shmio.falsification.trial import Task, run_trial
from shmio.lab import prepare_laboratory
from shmio.layout.values.codec import codec
from shmio.simulation import ModelRunner
from shmio.simulation.loading import load

sys.path.insert(0, str(ROOT))
from tests.nats_server import nats_server

EXAMPLE: Final = ROOT / "examples/falsify"
STEP_S: Final = 0.02
STEPS: Final = 1100
LEAST_MM: Final = 20
VALVE, TASK_BEGIN, TASK_END = 251, 351, 751
"""The steps in which the gate sees the cell's signals, without delay."""


def robustness(point: Point) -> float:
    """Run the gate alone, and return the robustness of the campaign's expectation."""
    runner = ModelRunner(load("gate:Gate", EXAMPLE))
    clearance = next(one for one in runner.layout.registers if one.path == "clearance")
    read = codec(clearance, runner.layout.byte_order).decode
    late_valve, late_task = (round(point[f"late-{name}.delay_ms"] / 1000 / STEP_S) for name in ("valve", "task"))
    found, signals = float("inf"), {"valve": False, "task": False}
    for step in range(1, STEPS + 1):
        now = {"valve": step >= VALVE + late_valve, "task": TASK_BEGIN <= step - late_task < TASK_END}
        if now != signals:
            runner.connect(now)
            signals = now
        dt_ns = round(STEP_S * 1e9)
        found = min(found, cast("float", read(runner.step(step * dt_ns, dt_ns))) - LEAST_MM)
    return found


def in_laboratory(read: CampaignFile, point: Point) -> float | None:
    """Return the robustness of a trial in the laboratory."""
    instance = prepare_laboratory(EXAMPLE / "supervisor.toml")
    return run_trial(instance, EXAMPLE, Task(0, {**read.space.at(point), "step_ms": 20.0})).robustness


def needed(read: CampaignFile, name: SearchName, seed: int, trials: int) -> int | None:
    """Return how many trials a search needs until one fails; None if it takes more than ``trials``."""
    search = begin_search(name, read.space, seed, trials, 1)
    for number in range(trials):
        point = search.ask(number)
        if point is None:
            return None
        found = robustness(point)
        if found < 0:
            return number + 1
        search.tell(number, found)
    return None


def speed(jobs: int, trials: int, *options: str) -> list[str]:
    """Run the command, and return trials a second and the factor over real time."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "shmio.cli.campaign", "falsify", str(EXAMPLE / "campaign.toml"), "--json"]
        command += ["--search", "random", "--trials", str(trials), "--jobs", str(jobs), "--all", "--shrink", "0"]
        command += ["-o", str(Path(folder) / "out"), *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not done.stdout:
        raise SystemExit(done.stderr)
    found = json.loads(done.stdout)
    return [f"{found['trials_per_s']:.2f}", f"{found['times_real_time']:.0f}"]


def farm_speed(workers: int, trials: int) -> list[str]:
    """Run the command with a farm on this host, whose workers run one trial at a time."""
    command = [sys.executable, "-m", "shmio.cli.campaign", "worker", "--farm"]
    with tempfile.TemporaryDirectory() as folder, nats_server(Path(folder)) as server, ExitStack() as stack:
        for _ in range(workers):
            one = stack.enter_context(subprocess.Popen([*command, server.url], stderr=subprocess.PIPE, text=True))
            stack.callback(one.terminate)
            assert one.stderr is not None
            assert "waiting for searches" in one.stderr.readline()
        return speed(workers, trials, "--farm", server.url)


def main() -> None:
    quick = begin("Falsification: trials a second, and trials until the planted fault is found")
    trials, seeds = (10, 1) if quick else (200, 10)
    table(["jobs", "trials/s", "times real time"], [[str(jobs), *speed(jobs, 2 if quick else 40)] for jobs in (1, 2)])
    rows = [[str(workers), *farm_speed(workers, 2 if quick else 40)] for workers in (1, 2)]
    table(["workers of a farm", "trials/s", "times real time"], rows)
    read = CampaignFile(EXAMPLE / "campaign.toml")
    point = {"late-valve.delay_ms": 4980, "late-task.delay_ms": 20, "noise.value": 1}
    assert robustness(point) == in_laboratory(read, point), (robustness(point), in_laboratory(read, point))
    rows = []
    for name in SEARCHES:
        found = [needed(read, name, seed, trials) for seed in range(seeds)]
        hits = [one for one in found if one is not None]
        median = statistics.median([trials + 1 if one is None else one for one in found])
        rows.append([name, f"{len(hits)} of {seeds}", f"{median:.0f}" if median <= trials else f"over {trials}"])
    table(["search", f"found within {trials} trials", "median trials"], rows)


if __name__ == "__main__":
    main()
