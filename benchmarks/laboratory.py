"""Steps for a second of CPU time in the laboratory, beside the bare runner of the same model.

The laboratory publishes each step, injects, judges and records. The bare runner only computes. The loop by hand does
the same work as the laboratory, but for exactly this campaign: it can do nothing else, and checks nothing. All run in
this process, in turns.
"""

from __future__ import annotations

import statistics
import struct
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
from common import DB201, HERE, begin, db201, interleave, keep, median_ratio, table

from shmio.campaigns.live import MAX_STEPS, Plan, frames_of
from shmio.config import Declaration, Expectation
from shmio.injection._numbers import uniform
from shmio.injection.draw import Purpose, SeededRandom
from shmio.judging.judge import Judge
from shmio.lab import Laboratory, prepare_laboratory
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.recording.writer import Writer
from shmio.segment import Block, Provenance, Quality, Segment
from shmio.segment.block import Layouts
from shmio.simulation import ModelRunner
from shmio.simulation.loading import load

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
BARE = "the bare runner"


@dataclass(frozen=True)
class Cell:
    """A model, a register to inject into, and a condition that becomes true early: ``sensor`` is over ``limit``."""

    model: str
    keys: str
    layout: Layout | None
    target: str
    sensor: str
    limit: float

    @property
    def condition(self) -> str:
        """The text of the condition."""
        return f"{self.sensor} > {self.limit}"

    def prepare(self, folder: Path) -> Callable[[], Laboratory]:
        """Return a function that creates a laboratory."""
        file = folder / "supervisor.toml"
        file.write_text(f'{CONFIG}model = "{self.model}"\n{self.keys}')
        plan = prepare_laboratory(file)
        return lambda: Laboratory(plan)

    def injections(self) -> list[Declaration]:
        """Return two injections, which are active nearly all the time."""
        tables: list[dict[str, Any]] = [
            {"name": "noise", "target": self.target, "operation": "noise", "amplitude": 0.1, "seed": 1},
            {"name": "offset", "target": self.target, "operation": "offset", "value": 1, "when": self.condition},
        ]
        return msgspec.convert(tables, list[Declaration])

    def expectations(self) -> list[Expectation]:
        """Return three expectations."""
        tables: list[dict[str, Any]] = [
            {"name": "limit", "never": f"abs({self.target}) > 1e9"},
            {"name": "answer", "when": self.condition, "within_s": 2, "then": f"{self.target} > -1e9"},
            {"name": "injected", "formula": f"always(abs({self.target} - raw({self.target})) < 3)"},
        ]
        return msgspec.convert(tables, list[Expectation])


CELLS = {
    "100 registers and an array of 100": Cell(
        "counting:Counting", f'folder = "{HERE}"\n', None, "cell/values/r00", "cell/values/r01", 100
    ),
    "the A50 cell": Cell(
        "shmio.simulation.a50:A50Cell",
        f'layout = "{DB201}"\n',
        db201(),
        "cell/Robot_800/Axs1_Pos",
        "cell/Robot_800/Axs1_Pos",
        10,
    ),
}


def bare(cell: Cell, steps: int) -> Callable[[], float]:
    """Make a sampler of the model's runner alone."""

    def sample() -> float:
        runner = ModelRunner(load(cell.model, HERE), cell.layout)
        dt_ns = round(STEP_S * 1e9)
        begun_s = time.process_time()
        for step in range(1, steps + 1):
            runner.step(step * dt_ns, dt_ns)
        return steps / (time.process_time() - begun_s)

    return sample


def laboratory(
    cell: Cell, folder: Path, steps: int, *, inject: bool = False, judge: bool = False, record: bool = False
) -> Callable[[], float]:
    """Make a sampler of a campaign, from its begin to the end of its recording."""
    create, number = cell.prepare(folder), count()

    def sample() -> float:
        recording = folder / f"{next(number)}.mem" if record else None
        run = Plan(
            cell.injections() if inject else [],
            cell.expectations() if judge else [],
            steps * STEP_S,
            record=recording,
        )
        with create() as lab:
            begun_s = time.process_time()
            lab.run(run)
            taken_s = time.process_time() - begun_s
        if recording:
            recording.unlink()
        return steps / taken_s

    return sample


def by_hand(cell: Cell, folder: Path, steps: int) -> Callable[[], float]:
    """Make a sampler of a loop that was written for one campaign, with the same parts as the laboratory."""
    cell.prepare(folder)
    plan = prepare_laboratory(folder / "supervisor.toml")
    recording = folder / "by hand.mem"

    def sample() -> float:
        runner = ModelRunner(load(cell.model, HERE), cell.layout)
        with Segment.private(plan.instance, plan.blocks, plan.processes, mode=plan.mode) as segment:
            block = segment.writer("cell").block
            begun_s = time.process_time()
            with recording.open("wb") as file:
                judge = Judge(cell.expectations(), Layouts(segment.blocks), {"cell": block.stale_ns})
                writer = Writer(file, {})
                channels = writer.open_block(block, 1, 0, 0)
                step = _injected(cell, runner, block)
                for first in range(1, steps + 1, MAX_STEPS):
                    numbers = range(first, min(first + MAX_STEPS, steps + 1))
                    for number in numbers:
                        step(number)
                    frames = [frame for number in numbers if (frame := block.read(number)) is not None]
                    judge.add("cell", frames_of(frames, block.layout.size, raws=True))
                    judge.turn()
                    for frame in frames:
                        writer.frame(channels, frame, frame.clock_ns)
                judge.finish()
                writer.finish()
            taken_s = time.process_time() - begun_s
        recording.unlink()
        return steps / taken_s

    return sample


def _injected(cell: Cell, runner: ModelRunner, block: Block) -> Callable[[int], None]:
    """Return a function that computes a step, injects into it, and publishes it."""
    target, sensor = (find(block.layout, path.removeprefix("cell/")) for path in (cell.target, cell.sensor))
    order = ">" if block.layout.byte_order == "big" else "<"
    value, sensed = (struct.Struct(order + {"REAL": "f", "LREAL": "d"}[one.type]) for one in (target, sensor))
    dt_ns, random = round(STEP_S * 1e9), SeededRandom(1, "noise")
    good, simulated, publish = Quality.GOOD, Provenance.SIMULATED, block.ring.publish

    def step(number: int) -> None:
        time_ns = number * dt_ns
        raw = runner.step(time_ns, dt_ns)
        image = bytearray(raw)
        (seen,) = value.unpack_from(raw, target.offset)
        seen += (2 * uniform(random.key, 1, number, Purpose.VALUE) - 1) * 0.1
        if sensed.unpack_from(raw, sensor.offset)[0] > cell.limit:
            seen += 1
        value.pack_into(image, target.offset, seen)
        publish(raw, image, number, time_ns, time_ns, time_ns, good, simulated, 0, 0, b"")

    return step


def main() -> None:
    quick = begin("The laboratory: steps for a second of CPU time")
    steps, rounds = (100, 1) if quick else (1_500, 9)
    for name, cell in CELLS.items():
        with tempfile.TemporaryDirectory() as text:
            folder = Path(text)
            contenders = {
                BARE: bare(cell, steps),
                "the laboratory": laboratory(cell, folder, steps),
                "with 2 injections": laboratory(cell, folder, steps, inject=True),
                "with 2 injections, 3 expectations": laboratory(cell, folder, steps, inject=True, judge=True),
                "the same, and a recording": laboratory(cell, folder, steps, inject=True, judge=True, record=True),
                "the same, a loop by hand": by_hand(cell, folder, steps),
            }
            samples = interleave(contenders, rounds)
        rows = [
            [
                contender,
                f"{max(values):,.0f}",
                f"{statistics.median(values):,.0f}",
                f"{median_ratio(values, samples[BARE]):.2f}",
            ]
            for contender, values in samples.items()
        ]
        for contender, _, _, ratio in rows[1:]:
            keep(f"{name}: {contender}, relative to the bare runner", float(ratio), "ratio", "more")
        table([name, "best", "median", "of the bare runner"], rows)


if __name__ == "__main__":
    main()
