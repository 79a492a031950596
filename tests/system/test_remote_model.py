"""A drive model computed by a client: run as the page shows it, run again, killed, and joined again."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import shmio
from shmio.testing.cell import BIN, PATIENCE_S, Cell, kill, until
from tests.system.page import environment, printed

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/how-to/remote-model.md").read_text()
CONFIG = """
[instance]
name = "{instance}"
clock = "stepped"

[[source]]
name = "sim"
connector = "simulation"
model = "shmio.simulation.loopback:Loopback"
writable = ["joints/**"]

[[source]]
name = "drive"
layout = "drive.toml"
writable = ["speed"]
DRIVE
[source.connections]
target = "sim/joints/Kuka.j1/R"

[grpc]
listen = ["{grpc}"]
"""
REMOTE = 'connector = "remote"\noutputs = ["position", "steps"]\ntimeout_ms = 9000'
LOCAL = 'connector = "simulation"\nmodel = "line:Drive"\nparameters = { tremble = 0.125 }\nseed = 3'
TABLE = """
[registers]
target = "LREAL"
speed = { type = "LREAL", initial = 0.5 }
position = "LREAL"
steps = "DINT"
"""
MODEL = '''
import time

from shmio.simulation import Input, Model, Output, Parameter


class Drive(Model):
    """Follows its target, and hangs when it is to be too fast."""

    tremble = Parameter("LREAL")
    target = Input("LREAL")
    speed = Input("LREAL", 0.5)
    position = Output("LREAL")
    steps = Output("DINT")

    def step(self, time_s, dt_s):
        if self.speed > 1000:
            time.sleep(3600)
        most = self.speed * dt_s
        self.position += max(-most, min(most, self.target - self.position)) + self.random.normal(0, self.tremble)
        self.steps += 1
'''
SERVE = """
import sys

from line import Drive
from shmio.client import connect
from shmio.simulation import ServedModel

model = ServedModel(Drive, {"tremble": float(sys.argv[2])}, seed=3)


def start(source):
    model.start(source)
    print("joined", flush=True)


with connect(sys.argv[1]) as cell:
    cell.simulate("drive", model.step, start=start, name="serve.py", patience_s=60)
"""
Frames = dict[int, tuple[int, bytes]]


@contextmanager
def served(cell: Cell, tremble: float = 0.0) -> Iterator[subprocess.Popen[str]]:
    """Run the drive's model; yield when it has joined."""
    command = [sys.executable, "serve.py", str(cell.grpc), str(tremble)]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{cell.folder}"}
    with subprocess.Popen(command, cwd=cell.folder, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "joined\n"
            until(lambda: cell.processes()["drive"]["quality"] == "good", "good quality")
            yield process
        finally:
            process.kill()


@pytest.fixture
def make_drive(make_cell: Callable[..., Cell], tmp_path: Path) -> Callable[[str], Cell]:
    """Return a function that writes an instance, which is not running yet."""
    for name, text in (("drive.toml", TABLE), ("line.py", MODEL), ("serve.py", SERVE)):
        (tmp_path / name).write_text(text)
    return lambda drive: make_cell(config=CONFIG.replace("DRIVE", drive))


def step(cell: Cell, *arguments: str) -> None:
    done = cell.run("shmio", "step", *arguments)
    assert done.returncode == 0, done.stderr


def put(cell: Cell, path: str, value: str) -> None:
    done = cell.run("shmio", "set", path, value)
    assert done.returncode == 0, done.stderr


def frames(cell: Cell, source: str) -> Frames:
    """Return the source's frame for each step: instance clock and bytes."""
    found: Frames = {}
    with shmio.attach(cell.instance) as reader:
        cursor = reader.block(source).cursor(after=0)
        while (frame := cursor.poll()) is not None:
            assert cursor.missed == 0
            if frame.cycle:
                found.setdefault(frame.cycle, (frame.clock_ns, frame.raw))
    return found


def campaign(cell: Cell, between: Callable[[], None] = lambda: None) -> tuple[Frames, Frames]:
    """Step and write; return the frames of both sources."""
    step(cell, "--dt-ms", "20", "--count", "4")
    put(cell, "sim/joints/Kuka.j1/R", "1.0")
    step(cell, "--dt-ms", "50", "--count", "4")
    between()
    put(cell, "drive/speed", "0.25")
    step(cell, "--dt-ms", "20", "--count", "4")
    return frames(cell, "drive"), frames(cell, "sim")


def remote_campaign(cell: Cell, tremble: float) -> tuple[Frames, Frames]:
    cell.up()
    with served(cell, tremble):
        found = campaign(cell)
    cell.down()
    return found


@pytest.mark.timeout(300)
def test_a_remote_model_repeats_exactly_and_equals_the_same_class_as_a_source(
    make_drive: Callable[[str], Cell],
) -> None:
    cell = make_drive(REMOTE)
    first = remote_campaign(cell, 0.125)
    assert remote_campaign(cell, 0.125) == first
    file = cell.folder / "supervisor.toml"
    file.write_text(file.read_text().replace(REMOTE, LOCAL))
    cell.up()
    until(lambda: cell.processes()["drive"]["quality"] == "good", "good quality")
    assert campaign(cell) == first
    assert list(first[0]) == list(range(1, 13))
    assert len({raw for _, raw in first[0].values()}) == 12, "each step gives another frame"


@pytest.mark.timeout(300)
def test_a_model_killed_between_steps_continues_after_rejoining(
    make_drive: Callable[[str], Cell],
) -> None:
    cell = make_drive(REMOTE)
    first = remote_campaign(cell, 0.0)
    cell.up()
    with served(cell) as model:

        def kill_it() -> None:
            model.kill()
            until(lambda: "no model is connected" in cell.processes()["drive"]["reason"], "a bad quality")
            again.__enter__()

        again = served(cell)
        try:
            assert campaign(cell, kill_it) == first
        finally:
            again.__exit__(None, None, None)


def test_a_kill_during_a_step_fails_it_and_the_next_step_works(make_drive: Callable[[str], Cell]) -> None:
    cell = make_drive(REMOTE)
    cell.up()

    def failing(killed: Callable[[], None]) -> str:
        """Kill a process during a step. Return the message of the failed step."""
        put(cell, "drive/speed", "5000")
        with (
            subprocess.Popen([BIN / "shmio", "step"], cwd=cell.folder, stderr=subprocess.PIPE, text=True) as command,
            shmio.attach(cell.instance) as reader,
        ):
            until(lambda: "waits for drive" in reader.clock.note, "the step waits")
            killed()
            _, error = command.communicate(timeout=PATIENCE_S)
        assert command.returncode == 1
        put(cell, "drive/speed", "1")
        return error

    with served(cell) as model:
        step(cell)
        assert "drive: model 'serve.py' disconnected before it answered" in failing(model.kill)
    with served(cell) as model:
        step(cell)
        pid = cell.processes()["drive"]["pid"]
        assert "drive: the source's process was restarted during this step" in failing(lambda: kill(pid))
    with served(cell) as model:  # the previous model hangs in its step
        step(cell)
        pid = cell.processes()["grpc"]["pid"]
        assert "drive: model 'serve.py' disconnected before it answered" in failing(lambda: kill(pid))
        model.kill()
        until(lambda: cell.processes()["grpc"]["pid"] not in (pid, None), "the endpoint's restart")
    with served(cell):
        step(cell)
        assert cell.processes()["drive"]["quality"] == "good"


def test_a_model_rejoins_a_restarted_endpoint(make_drive: Callable[[str], Cell]) -> None:
    cell = make_drive(REMOTE)
    cell.up()
    with served(cell) as model:
        step(cell)
        kill(cell.processes()["grpc"]["pid"])
        assert model.stdout is not None
        assert model.stdout.readline() == "joined\n"
        until(lambda: cell.processes()["drive"]["quality"] == "good", "good quality")
        step(cell)
        second = subprocess.run(
            [sys.executable, "serve.py", str(cell.grpc), "0"],
            cwd=cell.folder,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert "drive: model 'serve.py' (ipv4:127.0.0.1:" in second.stderr
        assert list(frames(cell, "drive")) == [1, 2]


# ---- the page --------------------------------------------------------------------------------------------------------


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)


def test_the_page_runs_as_shown(make_cell: Callable[..., Cell], tmp_path: Path, instance: str) -> None:
    cell = make_cell()
    address = str(cell.grpc)
    config, table = blocks("toml")
    assert ('name = "drive"\nclock' in config, '["127.0.0.1:8089"]' in config) == (True, True)
    config = config.replace('name = "drive"\nclock', f'name = "{instance}"\nclock').replace("127.0.0.1:8089", address)
    (tmp_path / "supervisor.toml").write_text(config)
    (tmp_path / "drive.toml").write_text(table)
    (tmp_path / "examples").mkdir()
    shutil.copy(ROOT / "examples/remote_model.py", tmp_path / "examples")
    begin, use = blocks("sh")
    (program,) = blocks("sh background")
    printed(begin, tmp_path, PYTHONPATH=str(ROOT))
    with subprocess.Popen(
        ["bash", "-c", f"exec {program.replace('127.0.0.1:8089', address)}"],
        cwd=tmp_path,
        env=environment(PYTHONPATH=str(ROOT)),
        stdout=subprocess.PIPE,
        text=True,
    ) as model:
        try:
            assert model.stdout is not None
            assert model.stdout.readline() == "joined drive, the position is 0\n"
            until(lambda: cell.processes()["drive"]["quality"] == "good", "good quality")
            out = printed(use, tmp_path, PYTHONPATH=str(ROOT))
            assert re.search(r"drive/position +0\.1\b", out), out
            model.send_signal(signal.SIGINT)
            assert model.wait(PATIENCE_S) == 130
        finally:
            model.kill()
    until(lambda: cell.processes()["drive"]["quality"] == "bad", "a bad quality")
    assert (
        'step 4: drive: no model is connected; connect one with simulate("drive", …)'
        in cell.run("shmio", "step").stderr
    )
