"""Models in a configuration: their layouts, and errors of models that cannot run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from shmio.errors import ConfigError
from shmio.plan.prepare import prepare
from tests.fmus import build

CONFIG = """
[instance]
name = "line"

[[source]]
name = "belt"
connector = "simulation"
MODEL

[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
"""
GATE = """
[[source]]
name = "gate"
connector = "simulation"
model = "line:Gate"
connections = { position = "belt/position", limit = "panel/limit", "more/closed" = "gate/closed" }
"""
MODELS = """
from shmio.simulation import Input, Model, Output, Parameter

print("a model that talks")

class Belt(Model):
    gain = Parameter("LREAL", 1.0)
    speed = Input("LREAL", 1.0)
    position = Output("LREAL")

    def step(self, time_s, dt_s):
        self.position += self.gain * self.speed * dt_s

class Gate(Model):
    position = Input("LREAL")
    limit = Input("LREAL")
    before = Input("BOOL", path="more/closed")
    closed = Output("BOOL")

    def step(self, time_s, dt_s):
        self.closed = self.position > self.limit
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "line.py").write_text(MODELS)
    (tmp_path / "broken.py").write_text("x = 1\ny = 1 / 0\n")
    (tmp_path / "ends.py").write_text(
        "import os, sys\nsys.stderr.write('no licence')\nsys.stderr.flush()\nos._exit(7)\n"
    )
    (tmp_path / "panel.toml").write_text('[registers]\nlimit = "LREAL"\nlamps = "ARRAY[1..3] OF BOOL"\n')
    return tmp_path


def written(folder: Path, model: str, more: str = GATE) -> Path:
    file = folder / "supervisor.toml"
    file.write_text(CONFIG.replace("MODEL", model) + more)
    return file


def test_model_declares_its_registers(folder: Path) -> None:
    prepared = prepare(written(folder, 'model = "line:Belt"\nparameters = { gain = 2 }\nseed = 4'))
    assert [register.path for register in prepared.layouts["belt"].registers] == ["speed", "position"]
    assert {block.source: block.attributes.stepped for block in prepared.plan.blocks} == {
        "belt": True,
        "gate": True,
        "panel": True,
    }
    belt = next(job for job in prepared.plan.jobs if job.name == "belt")
    assert belt.config["options"] == {
        "model": "line:Belt",
        "parameters": {"gain": 2},
        "seed": 4,
        "connections": {},
        "folder": str(folder),
        "strict": False,
        "text_length": 254,
    }


def test_layout_may_place_the_registers_of_a_model(folder: Path) -> None:
    (folder / "belt.toml").write_text('[registers]\nmore = "INT"\nposition = "LREAL"\nspeed = "LREAL"\n')
    prepared = prepare(written(folder, 'model = "line:Belt"\nlayout = "belt.toml"'))
    assert [register.path for register in prepared.layouts["belt"].registers] == ["more", "position", "speed"]


def test_changed_model_is_read_again(folder: Path) -> None:
    prepare(written(folder, 'model = "line:Belt"'))
    (folder / "line.py").write_text(MODELS.replace('speed = Input("LREAL", 1.0)', 'speed = Input("REAL")'))
    prepared = prepare(folder / "supervisor.toml")
    assert prepared.layouts["belt"].registers[0].type == "REAL"


def test_an_fmu_declares_its_registers_and_its_faults_are_reported(folder: Path) -> None:
    (folder / "models").mkdir()
    build("tank2", folder / "models")
    (folder / "models/bad.fmu").write_text("no archive")
    file = folder / "supervisor.toml"

    def tank(keys: str) -> Path:
        file.write_text(f'[instance]\nname = "line"\n[[source]]\nname = "tank"\nconnector = "simulation"\n{keys}\n')
        return file

    prepared = prepare(tank('model = "models/tank2.fmu"\nparameters = { area = 2.5 }'))
    assert [register.path for register in prepared.layouts["tank"].registers][:2] == ["pump.inflow", "level"]
    for keys, message in (
        ('model = "models/bad.fmu"', f"source[0].model: {folder}/models/bad.fmu: the archive is damaged"),
        ('model = "tank2.fmu"', f"source[0].model: {folder}/tank2.fmu: No such file or directory"),
        ('model = "models/tank2.fmu"\nparameters = { area = 0 }', "source[0].parameters.area: 0 is outside"),
        ('model = "models/tank2.fmu"\nconnections = { level = "tank/level" }', "valid: pump.inflow, pulses"),
    ):
        with pytest.raises(ConfigError) as caught:
            prepare(tank(keys))
        assert message in str(caught.value)


REMOTE = """
[instance]
name = "line"

[[source]]
name = "drive"
connector = "remote"
layout = "drive.toml"
KEYS

[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
"""


def remote(folder: Path, keys: str) -> Path:
    (folder / "drive.toml").write_text('[registers]\ntarget = "LREAL"\n"axis/position" = "LREAL"\nlamps = "BYTE"\n')
    file = folder / "supervisor.toml"
    file.write_text(REMOTE.replace("KEYS", keys))
    return file


def test_outputs_of_a_remote_model_are_in_the_segment(folder: Path) -> None:
    keys = 'outputs = ["axis"]\ninouts = ["lamps"]\nconnections = { target = "panel/limit" }\ntimeout_ms = 500'
    prepared = prepare(remote(folder, keys + '\n[grpc]\nlisten = ["127.0.0.1:8089"]\n'))
    drive, panel = prepared.plan.blocks
    assert (drive.attributes.outputs, drive.attributes.inouts) == (("axis",), ("lamps",))
    assert drive.attributes.stepped
    assert (drive.attributes.remote, panel.attributes.remote) == (True, False)
    assert prepared.plan.warnings == ()
    job = next(job for job in prepared.plan.jobs if job.name == "drive")
    assert job.config["options"]["timeout_ms"] == 500


def test_remote_model_without_an_endpoint_is_a_warning(folder: Path) -> None:
    (warning,) = prepare(remote(folder, 'outputs = ["axis"]')).plan.warnings
    assert "no model can connect to drive, because there is no [grpc] section" in warning


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("", "source[0].outputs: name the registers"),
        ('outputs = ["axes"]', "source[0].outputs: 'axes' matches no register of drive"),
        ('outputs = ["axis"]\ninouts = ["axis/position"]', "source[0].inouts: axis/position is in outputs, too"),
        ('output = ["axis"]', "source[0].output: unknown key"),
        ('outputs = ["axis"]\ntimeout_ms = 20000', "source[0].timeout_ms"),
        (
            'outputs = ["axis"]\nconnections = { "axis/position" = "panel/limit" }',
            "source[0].connections.axis/position: unknown input 'axis/position' of the model; valid: target, lamps",
        ),
        (
            'outputs = ["axis"]\nconnections = { target = "panel/lamps" }',
            "panel/lamps is BOOL[], which does not fit an input of LREAL",
        ),
    ],
)
def test_fault_of_a_remote_model_is_named_by_its_key(folder: Path, keys: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        prepare(remote(folder, keys))
    assert message in str(caught.value)
    assert all(line.startswith(str(folder)) for line in str(caught.value).splitlines()), "each fault has its line"


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("", "source[0].model: this key is needed"),
        ('model = "nowhere:Belt"', "source[0].model: there is no module nowhere"),
        ('model = "line:Bolt"', "source[0].model: unknown class 'Bolt' of line; did you mean 'Belt'?"),
        ('model = "line:print"', "source[0].model: unknown class 'print' of line"),
        ('model = "os:getcwd"', "source[0].model: os:getcwd is not a subclass of shmio.simulation.Model"),
        ('model = "broken:Belt"', "broken cannot be imported: ZeroDivisionError: division by zero (broken.py, line 2)"),
        ('model = "ends:Belt"', "the process that imports ends:Belt ended with status 7: no licence"),
        ('model = "line:Belt"\nspeed = 3', "source[0].speed: unknown key"),
        ('model = "line:Belt"\nseed = -1', "source[0].seed"),
        (
            'model = "line:Belt"\nparameters = { weight = 3 }',
            "parameters.weight: unknown parameter 'weight' of model Belt",
        ),
        ('model = "line:Belt"\nlayout = "panel.toml"', "source[0].layout: model line:Belt needs a register speed"),
        ('model = "line:Belt"\nconnections = { position = "gate/closed" }', "valid: speed"),
        (
            'model = "line:Belt"\nconnections = { speed = "gate/closed" }',
            "source[0].connections.speed: gate/closed is BOOL, which does not fit an input of LREAL",
        ),
        ('model = "line:Belt"\nconnections = { speed = "panel/lamps" }', "BOOL[], which does not fit"),
        ('model = "line:Belt"\nconnections = { speed = "panel/limits" }', "did you mean 'panel/limit'"),
        (
            'model = "line:Belt"\nconnections = { speed = "plc/limit" }',
            "source[0].connections.speed: no source 'plc' and no register 'plc/limit' in source 'belt'",
        ),
        ('model = "line:Belt"\nconnections = { speed = "panel/limit/in" }', "leave out /in"),
        ('model = "line:Belt"\nconnections = { speed = "SIMLOG://step" }', "source[0].connections.speed: "),
    ],
)
def test_fault_of_a_model_is_named_by_its_key(folder: Path, model: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        prepare(written(folder, model, more=GATE if "gate/" in model else ""))  # a process imports each model
    assert re.match(rf"{re.escape(str(folder / 'supervisor.toml'))}:[0-9]+: source\[0\]", str(caught.value))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
