"""Steps a second in the laboratory, beside the bare runner of the same model.

The laboratory injects, judges and records; the bare runner only computes. Both run in one process, in turns.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
from common import DB201, HERE, begin, interleave, table

from shmio.campaigns.live import Plan
from shmio.config import Declaration, Expectation
from shmio.lab import Laboratory, prepare_laboratory
from shmio.layout.model import Layout
from shmio.simulation import ModelRunner
from shmio.simulation.model import load

STEP_S = 0.02
CONFIG = """
[instance]
name = "laboratory"
clock = "stepped"

[[source]]
name = "cell"
connector = "simulation"
period_ms = 20
"""
COUNTING = f'model = "counting:Counting"\nfolder = "{HERE}"\n'
A50 = f'model = "shmio.simulation.a50:A50Cell"\nlayout = "{DB201}"\n'


def injections(target: str, condition: str) -> list[Declaration]:
    tables: list[dict[str, Any]] = [
        {"name": "noise", "target": target, "operation": "noise", "amplitude": 0.1, "seed": 1},
        {"name": "offset", "target": target, "operation": "offset", "value": 1, "when": condition, "seed": 1},
    ]
    return msgspec.convert(tables, list[Declaration])


def expectations(target: str, condition: str) -> list[Expectation]:
    tables = [
        {"name": "limit", "never": f"abs({target}) > 1e9"},
        {"name": "answer", "when": condition, "within_s": 2, "then": f"{target} > -1e9"},
        {"name": "injected", "formula": f"always(abs({target} - raw({target})) < 3)"},
    ]
    return msgspec.convert(tables, list[Expectation])


def laboratory(
    folder: Path, model: str, target: str, condition: str, steps: int, *, full: bool, record: bool
) -> Callable[[], float]:
    """Make a sampler of a campaign, from its begin to the end of its recording."""
    file = folder / "supervisor.toml"
    file.write_text(CONFIG + model)
    plan = prepare_laboratory(file)
    number = count()

    def sample() -> float:
        recording = folder / f"{next(number)}.mem" if record else None
        run = Plan(
            injections(target, condition) if full else [],
            expectations(target, condition) if full else [],
            steps * STEP_S,
            record=recording,
        )
        with Laboratory(plan) as lab:
            begun_s = time.process_time()
            lab.run(run)
            taken_s = time.process_time() - begun_s
        if recording:
            recording.unlink()
        return steps / taken_s

    return sample


def bare(model: str, folder: Path, layout: Layout | None, steps: int) -> Callable[[], float]:
    """Make a sampler of the model's runner alone."""

    def sample() -> float:
        runner = ModelRunner(load(model, folder), layout)
        dt_ns = round(STEP_S * 1e9)
        begun_s = time.process_time()
        for step in range(1, steps + 1):
            runner.step(step * dt_ns, dt_ns)
        return steps / (time.process_time() - begun_s)

    return sample


def main() -> None:
    quick = begin("The laboratory: steps a second")
    steps, rounds = (100, 1) if quick else (3_000, 3)
    from common import db201

    rows = []
    with tempfile.TemporaryDirectory() as text:
        for name, section, target, condition, runner in (
            ("100 registers", COUNTING, "cell/values/r00", "cell/values/r01 > 100", ("counting:Counting", None)),
            ("A50", A50, "cell/Robot_800/Axs1_Pos", "cell/Robot_800/Axs1_Pos > 90", ("shmio.simulation.a50:A50Cell", db201())),
        ):
            folder = Path(text)
            contenders = {
                "the bare runner": bare(runner[0], HERE, runner[1], steps),
                "laboratory": laboratory(folder, section, target, condition, steps, full=False, record=False),
                "with injections and judging": laboratory(folder, section, target, condition, steps, full=True, record=False),
                "with injections, judging and recording": laboratory(folder, section, target, condition, steps, full=True, record=True),
            }
            medians = {key: statistics.median(values) for key, values in interleave(contenders, rounds).items()}
            own = medians["the bare runner"]
            rows += [[name, key, f"{value:,.0f}", f"{value / own:.2f}"] for key, value in medians.items()]
    table(["model", "", "steps/s", "of the bare runner"], rows)


if __name__ == "__main__":
    main()
