"""Processes of trials: results, crashes, hangs, and a dead parent."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shmio.falsification.pool import Pool
from shmio.falsification.trial import Task

CONFIG = """
[instance]
name = "falsify-test"
clock = "stepped"

[[source]]
name = "lift"
connector = "simulation"
model = "falsify_lift:Lift"
period_ms = 20
"""
MODEL = """
import os
import time
from shmio.simulation import Input, Model, Output, Parameter

class Lift(Model):
    speed = Input("LREAL", initial=1.0)
    height = Output("LREAL")
    how = Parameter("INT", initial=0)

    def step(self, time_s, dt_s):
        self.height += self.speed * dt_s
        print("models may print")
        if time_s > 0.05 and self.how == 1:
            raise ValueError("out of order")
        if time_s > 0.05 and self.how == 2:
            os._exit(5)
        if time_s > 0.05 and self.how == 3:
            os.kill(os.getpid(), 11)
        if time_s > 0.05 and self.how == 4:
            time.sleep(1000)
        if self.how == 5:
            self.height = float("nan")
        if self.how == 6:
            self.height = float("inf")
"""
NAN = "allow_nonfinite = ['**']\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "falsify_lift.py").write_text(MODEL)
    (tmp_path / "supervisor.toml").write_text(CONFIG + NAN)
    return tmp_path


@pytest.fixture
def task() -> Callable[..., Task]:
    def made(number: int, how: int = 0, value: float = 0.0, **keys: Any) -> Task:
        injection = {"name": "push", "target": "lift/height", "operation": "offset", "value": value, "seed": 0, **keys}
        return Task(
            number,
            {
                "duration_s": 0.2,
                "step_ms": 20.0,
                "parameters": {"lift": {"how": how}},
                "injection": [injection],
                "expect": [
                    {"name": "low", "always": "lift/height < 0.5"},
                    {"name": "asked", "when": "lift/height > 0.1", "within_s": 0.02, "then": "lift/height > 0.11"},
                ],
            },
        )

    return made


def test_trials_have_results_whatever_happens(folder: Path, task: Callable[..., Task]) -> None:
    with Pool(folder / "supervisor.toml", folder, 2, 60) as pool:
        passed = pool.run(task(1))
        assert (passed.number, passed.status, passed.reason) == (1, "passed", "")
        assert passed.robustness == pytest.approx(0.01)
        assert passed.worst is not None
        assert passed.worst.name == "asked"
        assert passed.simulated_s == pytest.approx(0.2)
        failed = pool.run(task(2, value=1.0, start_s=0.1))
        assert (failed.status, failed.failed) == ("failed", ["low"])
        assert failed.robustness == pytest.approx(-0.7)
        assert failed.expectations[0].moment_s == pytest.approx(0.1)
        unmet = pool.run(task(3, value=-1.0))
        assert unmet.status == "inconclusive"
        assert unmet.robustness is not None
        assert unmet.robustness > 0
        for how, reason in ((1, "out of order"), (2, "ended with status 5"), (3, "ended by SIGSEGV")):
            bad = pool.run(task(how, how))
            assert (bad.number, bad.status, bad.robustness) == (how, "error", None)
            assert reason in bad.reason
        assert pool.run(task(7, value=1.0, probability=2)).status == "invalid"
        assert pool.run(task(8, target="lift/nothing")).status == "invalid"
        nan, infinite = pool.run(task(9, 5)), pool.run(task(10, 6))
        assert nan.status == "inconclusive"
        assert nan.robustness is None or nan.robustness > 0
        assert infinite.status == "failed"
        assert infinite.robustness == -1e300


def test_a_trial_that_hangs_is_ended(folder: Path, task: Callable[..., Task]) -> None:
    with Pool(folder / "supervisor.toml", folder, 1, 5) as pool:
        hung = pool.run(task(1, 4))
        assert (hung.status, hung.number) == ("error", 1)
        assert "longer than 5 s (--limit)" in hung.reason
        assert pool.run(task(2)).status == "passed"


def test_a_cancelled_trial_has_no_result(folder: Path, task: Callable[..., Task]) -> None:
    with Pool(folder / "supervisor.toml", folder, 1, 100) as pool:
        pool.submit(task(1, 4))
        assert pool.idle == 0
        assert pool.wait(0.05) == []
        pool.cancel()
        assert pool.idle == 1
        assert pool.run(task(2)).number == 2


def test_a_process_ends_with_its_parent(folder: Path) -> None:
    command = [sys.executable, "-m", "shmio.falsification.worker", "1", str(folder / "supervisor.toml"), str(folder)]
    done = subprocess.run(command, stdin=subprocess.PIPE, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, "its parent is not process 1, so it ended at once"


def test_a_process_that_hangs_at_its_start_delays_nobody(folder: Path, task: Callable[..., Task]) -> None:
    """Its pipe has room for 64 KiB only."""
    long = " or ".join(["lift/height > 1000"] * 6000)
    with Pool(folder / "supervisor.toml", folder, 1, 60) as pool:
        (folder / "falsify_lift.py").write_text("import time\ntime.sleep(1000)")
        pool.submit(task(1, when=long))
        assert pool.wait(0.05) == []
        pool.cancel()
        (folder / "falsify_lift.py").write_text(MODEL)
        assert pool.run(task(2, when=long)).status == "invalid", "it came whole: conditions are shorter than this"
