"""An exported instance is an FMU that FMPy and shmio run, with the results of the instance."""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import signal
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.simulation import instantiate_fmu
from fmpy.validation import validate_fmu

from shmio.lab import Laboratory, prepare_laboratory
from shmio.lab.fmu.secrets import MARK
from shmio.testing.cell import BIN, until
from tests.fmus import build

CONFIG = """
[instance]
name = "exported"

[[source]]
name = "belt"
connector = "simulation"
model = "export_line:Belt"
seed = 3
period_ms = 20
writable = ["**"]

[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
writable = ["speed"]
"""
MODEL = """
from shmio.simulation import Input, Model, Output

class Belt(Model):
    speed = Input("LREAL", 1.0, unit="m/s", comment="of the <belt>")
    limit = Input("REAL", 100.0)
    lots = Input("ARRAY[1..3] OF DINT")
    run = Input("BOOL", True)
    label = Input("STRING[20]", "a & b")
    position = Output("LREAL", unit="m")
    total = Output("DINT")
    names = Output("STRING[30]")
    flags = Output("ARRAY[0..2] OF BOOL")

    def step(self, time_s, dt_s):
        if self.speed > 50:
            raise ValueError("too fast")
        if self.run:
            self.position = min(self.limit, self.position + self.speed * dt_s * self.random.random())
        self.total = sum(self.lots)
        self.names = self.label + "!"
        self.flags = [self.position > one for one in range(3)]
"""
PANEL = '[registers]\nspeed = "UDINT"\nname = "STRING[10]"\nday = "DATE"\n'
STEP_S = 0.1


@pytest.fixture
def export(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that exports the instance, and returns the FMU."""
    (tmp_path / "export_line.py").write_text(MODEL)
    (tmp_path / "panel.toml").write_text(PANEL)
    (tmp_path / "supervisor.toml").write_text(CONFIG)

    def exported(*words: str, **environment: str) -> Path:
        done = subprocess.run(
            [BIN / "shmio-supervisor", "export-fmu", "-o", "cell.fmu", *words],
            cwd=tmp_path, capture_output=True, text=True, check=False, env=os.environ | environment,
        )  # fmt: skip
        if done.returncode:
            raise AssertionError(done.stderr)
        return tmp_path / "cell.fmu"

    return exported


def children() -> set[int]:
    return {int(pid) for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}


def test_fmpy_gets_the_results_of_the_instance(export: Callable[..., Path], tmp_path: Path) -> None:
    file = export()
    assert validate_fmu(str(file)) == []
    description = fmpy.read_model_description(str(file))
    found = {one.name: (one.causality, one.type, one.unit, one.start) for one in description.modelVariables}
    assert found["belt/speed"] == ("input", "Real", "m/s", "1.0")
    assert found["belt/label"] == ("input", "String", None, "a & b")
    assert found["belt/lots/3"] == ("input", "Integer", None, "0")
    assert found["belt/position"] == ("output", "Real", "m", None)
    assert found["panel/speed"][:2] == ("input", "Real")
    assert found["panel/name"][:2] == ("output", "String")
    assert "panel/day" not in found
    before = children()
    theirs = fmpy.simulate_fmu(
        str(file), stop_time=1.0, output_interval=STEP_S,
        output=["belt/position", "belt/total", "belt/flags/1", "belt/limit", "panel/speed"],
        start_values={"belt/speed": 7.5, "belt/lots/2": 4, "panel/speed": 3_000_000_000.0, "belt/limit": 2.5},
    )  # fmt: skip
    assert children() == before, "the FMU has ended its process"
    with Laboratory(prepare_laboratory(tmp_path / "supervisor.toml")) as lab, lab.attach() as cell:
        cell.write({"belt/speed": 7.5, "belt/lots/2": 4, "belt/limit": 2.5})
        positions = []
        for _ in range(10):
            cell.step(STEP_S)
            positions.append(cell["belt/position"])
    assert theirs["belt/position"][1:].tolist() == positions
    assert positions[-1] == 2.5
    assert theirs["belt/flags/1"][-1]
    assert (theirs["belt/total"][-1], theirs["panel/speed"][-1]) == (4, 3_000_000_000)


class Instances:
    """Instances of an FMU, and the messages of its logger."""

    def __init__(self, file: Path, folder: Path) -> None:
        self.description = fmpy.read_model_description(str(file))
        self.references = {one.name: one.valueReference for one in self.description.modelVariables}
        self._folder = fmpy.extract(str(file), str(folder / "extracted"))
        self.messages: list[str] = []

    def make(self) -> Any:
        def log(*arguments: Any) -> None:
            self.messages.append((arguments[-1] or b"").decode())

        fmu = instantiate_fmu(self._folder, self.description, "CoSimulation", logger=log)
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        return fmu


def test_several_at_once_and_failures_are_logged(export: Callable[..., Path], tmp_path: Path) -> None:
    made = Instances(export(), tmp_path)
    before = children()
    first, second = made.make(), made.make()
    speed, position = made.references["belt/speed"], made.references["belt/position"]
    first.setReal([speed], [10.0])
    first.doStep(0.0, STEP_S)
    assert first.getReal([position])[0] > 0
    assert second.getReal([position]) == [0.0]
    with pytest.raises(FMICallException):
        first.getReal([99])
    assert "there is no Real 99" in made.messages[-1]
    first.freeInstance()
    with pytest.raises(FMICallException):
        second.doStep(5.0, STEP_S)
    assert "the step begins at 5 s, but the instance is at 0 s" in made.messages[-1]
    second.freeInstance()
    third = made.make()
    third.setReal([speed], [60.0])
    with pytest.raises(FMICallException):
        third.doStep(0.0, STEP_S)
    assert any("too fast (export_line.py, line" in text for text in made.messages)
    third.freeInstance()
    fourth = made.make()
    (child,) = children() - before
    os.kill(child, signal.SIGKILL)
    until(lambda: Path(f"/proc/{child}/stat").read_text().split()[2] == "Z", "the end of the process")
    with pytest.raises(FMICallException):
        fourth.doStep(0.0, STEP_S)
    assert "the process of the instance has ended" in made.messages[-1]
    fourth.freeInstance()
    assert children() == before


def test_it_is_coupled_with_another_fmu(export: Callable[..., Path], tmp_path: Path) -> None:
    other = tmp_path / "coupled"
    other.mkdir()
    shutil.copy(export("--only", "belt"), other)
    build("tank2", other)
    (other / "supervisor.toml").write_text("""
[instance]
name = "coupled"
[[source]]
name = "tank"
connector = "simulation"
model = "tank2.fmu"
period_ms = 20
[source.connections]
"pump.inflow" = "belt/belt%2Fposition"
[[source]]
name = "belt"
connector = "simulation"
model = "cell.fmu"
period_ms = 20
[source.connections]
"belt%2Fspeed" = "tank/level"
""")
    levels = []
    for _ in range(2):
        with Laboratory(prepare_laboratory(other / "supervisor.toml")) as lab, lab.attach() as cell:
            cell.step(STEP_S, 20)
            levels.append((cell["tank/level"], cell["belt/belt%2Fposition"]))
    assert levels[0] == levels[1]
    assert levels[0][1] != 0
    assert all(isinstance(value, float) and math.isfinite(value) for value in levels[0])


SECRET = "secret-0123456789abcdef"
ENDPOINTS = f"""
# the old password = {SECRET}
[grpc]
listen = ["127.0.0.1:1"]
[[grpc.token]]
name = "a"
roles = ["read"]
token_file = "token.csv"
[[grpc.token]]
name = "b"
roles = ["read"]
sha256 = "{hashlib.sha256(SECRET.encode()).hexdigest()}"
[[alert]]
name = "bad"
bad = ["belt"]
webhook = "http://127.0.0.1/{SECRET}"
webhook_header_file = "headers.ini"
"""
OTHER = f"""
[instance]
name = "other"
[[source]]
name = "plc"
connector = "mtconnect"
password = "{SECRET}"
user_key = "own.json"
"""
KEYED = """
from shmio.simulation import Model, Output, Parameter

class Keyed(Model):
    api_key = Parameter("STRING[40]", "")
    pin = Parameter("INT", 0)
    length = Output("INT")

    def step(self, time_s, dt_s):
        self.length = len(self.api_key) + self.pin
"""


def test_secrets_are_left_out_and_asked_for(tmp_path: Path) -> None:
    """Whoever gets the FMU can read its files."""
    source = '[[source]]\nname = "s"\nconnector = "simulation"\nmodel = "keyed:Keyed"\nperiod_ms = 20\n'
    source += f'parameters = {{ api_key = "{SECRET}", pin = 7 }}\n'
    files = {
        "token.csv": SECRET,
        "headers.ini": f"Authorization: Bearer {SECRET}",
        "other/own.json": SECRET,
        "other/supervisor.toml": OTHER,
    }
    (tmp_path / "other").mkdir()
    for name, text in files.items():
        (tmp_path / name).touch(0o600)
        (tmp_path / name).write_text(text)
    (tmp_path / "keyed.py").write_text(KEYED)
    (tmp_path / "other" / "tags.toml").write_text('[registers]\npassword = "INT"\n')
    (tmp_path / "supervisor.toml").write_text('[instance]\nname = "keyed"\n' + source + ENDPOINTS)
    command: list[str | Path] = [BIN / "shmio-supervisor", "export-fmu", "-o", "cell.fmu"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stderr.splitlines() == [
        "left out, because they may have secrets: headers.ini, token.csv, other/own.json, other/supervisor.toml",
        "left out, because their values may be secret, and the FMU asks for them: source[0].parameters.api_key",
    ]
    with zipfile.ZipFile(tmp_path / "cell.fmu") as fmu:
        found = {name: fmu.read(name) for name in fmu.namelist()}
    assert {name.removeprefix("resources/cell/") for name in found if name.startswith("resources/cell/")} == {
        "keyed.py",
        "other/tags.toml",
        "supervisor.toml",
    }
    hidden = SECRET.encode(), hashlib.sha256(SECRET.encode()).hexdigest().encode()
    assert [name for name, data in found.items() if any(one in data for one in hidden)] == []
    made = Instances(tmp_path / "cell.fmu", tmp_path)
    with pytest.raises(Exception, match="instantiate"):
        made.make()
    assert "source[0].parameters.api_key: the export has left this secret out; write it into" in made.messages[-1]
    file = Path(made._folder) / "resources" / "cell" / "supervisor.toml"
    file.write_text(file.read_text().replace(MARK, "12345"))
    fmu = made.make()
    fmu.doStep(0.0, STEP_S)
    assert fmu.getInteger([made.references["s/length"]]) == [5 + 7]
    fmu.terminate()
    fmu.freeInstance()


def test_what_cannot_be_exported_is_named(export: Callable[..., Path], tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"needs a C compiler.*apt install"):
        export(PATH="/nonexistent")
    with pytest.raises(AssertionError, match="nothing"):
        export("--only", "belt/nothing")
    made = Instances(export(), tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SHMIO_PYTHON", "/bin/false")
        with pytest.raises(Exception, match="instantiate"):
            made.make()
    assert "/bin/false does not run shmio" in made.messages[-1]
    device = '[[source]]\nname = "plc"\nconnector = "s7"\nlayout = "panel.toml"\nhost = "127.0.0.1"\n'
    (tmp_path / "supervisor.toml").write_text(CONFIG + device)
    with pytest.raises(AssertionError, match="plc"):
        export()
