"""Steps of FMUs a second: by FMPy alone, by shmio's model runner, and in an instance.

FMPy simulates with its own loop and records the outputs. The runner makes the same steps, and has the outputs in its
image. In the instance, a program on the host steps, and each step has a frame in the shared memory. The FMUs of the
tests are compiled from C: a tank (FMI 2.0, 4 inputs and 5 outputs) and two axes (FMI 3.0, arrays, 6 inputs and 7
outputs). In the last tables, two tanks fill each other, and the A50 cell is computed beside them. Each tank's step
takes some CPU time, as the solver of a real FMU does.
"""

from __future__ import annotations

import itertools
import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from common import ROOT, begin, interleave, per_second, report
from instance import started
from step import local

from shmio.lab import Laboratory, prepare_laboratory
from shmio.simulation import ModelRunner, load
from shmio.simulation.a50 import A50Cell

sys.path.insert(0, str(ROOT))
from tests.fmus import build

DT_NS = 20_000_000
OURS = "shmio, the runner alone"
LABORATORY = "shmio, a laboratory: one process"
FMPY_AND_CELL = "FMPy in a loop, with the runner of the A50 cell"
OUTPUTS = {
    "tank2": ["level", "runs", "a/b caption", "phase", "calls"],
    "plant3": ["position", "small_out", "bits_out", "text_out", "big_out", "byte", "mode"],
}
SOURCE = """
[[source]]
name = "sim"
connector = "simulation"
model = "{file.name}"
folder = "{file.parent}"
"""


def extracted(file: Path) -> tuple[str, Any]:
    """Extract an FMU. Return the folder, and FMPy's model description."""
    import fmpy  # noqa: PLC0415

    folder = fmpy.extract(str(file), str(file.with_suffix("")))
    return folder, fmpy.read_model_description(folder)


def alone(file: Path, outputs: list[str], count: int) -> Callable[[], float]:
    """Make a sampler of the steps a second of FMPy, without the extraction."""
    import fmpy  # noqa: PLC0415

    folder, description = extracted(file)

    def sample() -> float:
        fmu = fmpy.instantiate_fmu(folder, description, "CoSimulation")
        begun_s = time.perf_counter()
        results = fmpy.simulate_fmu(
            folder,
            stop_time=count * DT_NS / 1e9,
            output_interval=DT_NS / 1e9,
            output=outputs,
            model_description=description,
            fmu_instance=fmu,
            validate=False,
        )
        taken_s = time.perf_counter() - begun_s
        fmu.freeInstance()
        return (len(results) - 1) / taken_s

    return sample


def by_runner(file: Path, count: int) -> Callable[[], float]:
    """Make a sampler of the steps a second of the model runner."""

    def sample() -> float:
        runner = ModelRunner(load(file.name, file.parent))
        runner.begin()
        begun_s = time.perf_counter()
        for number in range(1, count + 1):
            runner.step(number * DT_NS, DT_NS)
        taken_s = time.perf_counter() - begun_s
        runner.close()
        return count / taken_s

    return sample


WORKS_US = (0, 100, 300, 1000)
HEAD = '[instance]\nname = "coupled"\nclock = "stepped"\n'
COUPLED = """
[[source]]
name = "one"
connector = "simulation"
model = "{file.name}"
folder = "{file.parent}"
connections = {{ "pump.inflow" = "two/phase" }}
[[source]]
name = "two"
connector = "simulation"
model = "{file.name}"
folder = "{file.parent}"
connections = {{ "pump.inflow" = "one/phase" }}
[[source]]
name = "cell"
connector = "simulation"
model = "shmio.simulation.a50:A50Cell"
"""


def laboratory(config: Path, duration_s: float) -> Callable[[], float]:
    """Make a sampler of the steps a second of all sources in this process."""
    plan = prepare_laboratory(config)

    def sample() -> float:
        with Laboratory(plan) as lab, lab.attach() as cell:
            cell.step(DT_NS / 1e9)
            return per_second(lambda: cell.step(DT_NS / 1e9), duration_s)()

    return sample


def coupled_alone(file: Path, duration_s: float, *, cell: bool) -> Callable[[], float]:
    """Make a sampler of the steps a second of two FMUs that a loop over FMPy couples.

    With ``cell``, the loop also lets the bare runner compute the A50 cell.
    """
    import fmpy  # noqa: PLC0415

    folder, description = extracted(file)
    references = {variable.name: variable.valueReference for variable in description.modelVariables}
    inflow, shown = [references["pump.inflow"]], [references["phase"], references["level"]]

    def sample() -> float:
        pair = [fmpy.instantiate_fmu(folder, description, "CoSimulation") for _ in range(2)]
        for fmu in pair:
            fmu.setupExperiment(startTime=0.0)
            fmu.enterInitializationMode()
            fmu.exitInitializationMode()
        beside = ModelRunner(A50Cell) if cell else None
        numbers = itertools.count()

        def step() -> None:
            number = next(numbers)
            begin_s = number * DT_NS / 1e9
            if beside is not None:
                beside.step((number + 1) * DT_NS, DT_NS)
            phases = [fmu.getReal(shown)[0] for fmu in pair]
            for fmu, phase in zip(pair, reversed(phases), strict=True):
                fmu.setReal(inflow, [phase])
                fmu.doStep(begin_s, DT_NS / 1e9)

        rate = per_second(step, duration_s)()
        for fmu in pair:
            fmu.terminate()
            fmu.freeInstance()
        return rate

    return sample


def main() -> None:
    quick = begin("FMUs: steps a second, next to FMPy alone")
    count, duration_s, rounds = (200, 0.2, 1) if quick else (10_000, 0.5, 5)
    with tempfile.TemporaryDirectory() as folder:
        for name, outputs in OUTPUTS.items():
            file = build(name, Path(folder))
            with ExitStack() as stack:
                running = stack.enter_context(started([], more=SOURCE.format(file=file), clock="stepped"))
                samples = interleave(
                    {
                        OURS: by_runner(file, count),
                        "FMPy alone": alone(file, outputs, count),
                        "shmio, an instance": local(running.segment.instance, duration_s),
                    },
                    rounds,
                )
            report(f"{name}.fmu", "steps/s", samples, OURS, "more", "FMPy alone")
        file = build("tank2", Path(folder))
        config = Path(folder) / "supervisor.toml"
        config.write_text(HEAD + COUPLED.format(file=file))
        for work_us in WORKS_US[:1] if quick else WORKS_US:
            os.environ["TANK_WORK_US"] = str(work_us)
            with started([], more=COUPLED.format(file=file), clock="stepped") as running:
                ours = "shmio, an instance: three processes"
                samples = interleave(
                    {
                        ours: local(running.segment.instance, duration_s),
                        LABORATORY: laboratory(config, duration_s),
                        FMPY_AND_CELL: coupled_alone(file, duration_s, cell=True),
                        "FMPy in a loop, the FMUs only": coupled_alone(file, duration_s, cell=False),
                    },
                    rounds,
                )
            title = f"two coupled tanks of {work_us} us and the A50 cell"
            report(title, "steps/s", samples, ours, "more", FMPY_AND_CELL)
            alike = {name: samples[name] for name in (LABORATORY, FMPY_AND_CELL)}
            report(f"{title}, in one process", "steps/s", alike, LABORATORY, "more", FMPY_AND_CELL)


if __name__ == "__main__":
    main()
