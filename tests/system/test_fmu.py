"""FMUs as sources of an instance: in real time and by steps, and FMUs that crash or hang."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import fmpy
import pytest

import shmio
from shmio.errors import TimeError
from shmio.testing.cell import Cell, until
from tests.fmus import build

CONFIG = """
[instance]
name = "{instance}"
clock = "CLOCK"

[[source]]
name = "tank"
connector = "simulation"
model = "models/tank2.fmu"
parameters = {{ area = 3.0 }}
period_ms = 20
writable = ["pump.inflow"]
[source.connections]
trouble = "panel/trouble"

[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
writable = ["**"]

[grpc]
listen = ["{grpc}"]
"""


@pytest.fixture
def make_tank(make_cell: Callable[..., Cell]) -> Callable[[str], Cell]:
    """Return a function that starts an instance with the FMU."""

    def make(clock: str) -> Cell:
        cell = make_cell(config=CONFIG.replace("CLOCK", clock))
        (cell.folder / "models").mkdir()
        build("tank2", cell.folder / "models")
        (cell.folder / "panel.toml").write_text('[registers]\ntrouble = "DINT"\n')
        cell.up()
        until(lambda: quality(cell) == "good", "good quality")
        return cell

    return make


def quality(cell: Cell, source: str = "tank") -> str:
    return str(cell.processes()[source]["quality"])


def reason(cell: Cell) -> str:
    return str(cell.processes()["tank"]["reason"])


def test_steps_equal_fmpy_and_the_fmu_ends_cleanly(
    make_tank: Callable[[str], Cell], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TANK_ENDS", str(tmp_path / "ends"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    cell = make_tank("stepped")
    levels = []
    with shmio.attach(cell.instance, writable=True) as attached:
        for _ in range(50):
            attached.step(dt_s=0.02)
            levels.append(attached["tank/level"])
    file = str(cell.folder / "models/tank2.fmu")
    theirs = fmpy.simulate_fmu(file, stop_time=1.0, output_interval=0.02, output=["level"], start_values={"area": 3.0})
    assert levels == theirs["level"][1:].tolist()
    (tmp_path / "ends").unlink()
    cell.down()
    assert (tmp_path / "ends").read_text() == "terminate\nfree\n"
    assert not list(tmp_path.glob("shmio-fmu-*"))


COUPLED = """
[instance]
name = "{instance}"
clock = "stepped"

[[source]]
name = "one"
connector = "simulation"
model = "tank2.fmu"
connections = {{ "pump.inflow" = "two/phase" }}

[[source]]
name = "two"
connector = "simulation"
model = "tank2.fmu"
parameters = {{ area = 5.0 }}
connections = {{ "pump.inflow" = "one/level" }}

[grpc]
listen = ["{grpc}"]
"""


def test_two_coupled_fmus_equal_a_loop_over_fmpy(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    cell = make_cell(config=COUPLED)
    file = build("tank2", cell.folder)
    cell.up()
    levels = []
    with shmio.attach(cell.instance, writable=True) as attached:
        for _ in range(30):
            attached.step(dt_s=0.02)
            levels.append([attached["one/level"], attached["two/level"]])
    folder = fmpy.extract(str(file), str(tmp_path / "extracted"))
    description = fmpy.read_model_description(folder)
    reference = {one.name: one.valueReference for one in description.modelVariables}
    pair = [fmpy.instantiate_fmu(folder, description, "CoSimulation") for _ in range(2)]
    pair[1].setReal([reference["area"]], [5.0])
    for fmu in pair:
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
    theirs = []
    for number in range(30):
        given = [pair[1].getReal([reference["phase"]]), pair[0].getReal([reference["level"]])]
        for fmu, value in zip(pair, given, strict=True):
            fmu.setReal([reference["pump.inflow"]], value)
            fmu.doStep(number * 0.02, (number + 1) * 0.02 - number * 0.02)
        theirs.append([fmu.getReal([reference["level"]])[0] for fmu in pair])
    for fmu in pair:
        fmu.terminate()
        fmu.freeInstance()
    assert levels == theirs


def test_an_fmu_that_crashes_fails_its_step_and_begins_again(make_tank: Callable[[str], Cell]) -> None:
    cell = make_tank("stepped")
    with shmio.attach(cell.instance, writable=True) as attached:
        attached.step()
        attached.write({"panel/trouble": 1})
        with pytest.raises(TimeError, match=r"tank: the source's process was restarted .* \(killed by SIGSEGV\)$"):
            attached.step()
        attached.write({"panel/trouble": 0})
        attached.step()
        assert attached["tank/runs"] == 1


def test_in_real_time_an_fmu_that_crashes_is_a_bad_source_with_a_reason(make_tank: Callable[[str], Cell]) -> None:
    cell = make_tank("wall")
    pid = cell.processes()["panel"]["pid"]
    with shmio.attach(cell.instance, writable=True) as attached:
        attached.write({"panel/trouble": 1})
        until(lambda: reason(cell) == "the source's process was restarted: killed by SIGSEGV", "the reason")
        assert quality(cell) == "bad"
        assert (quality(cell, "panel"), cell.processes()["panel"]["pid"]) == ("good", pid)
        attached.write({"panel/trouble": 0})
        until(lambda: quality(cell) == "good", "it runs again")


def test_in_real_time_an_fmu_that_hangs_is_a_bad_source_that_can_be_restarted(
    make_tank: Callable[[str], Cell],
) -> None:
    cell = make_tank("wall")
    with shmio.attach(cell.instance, writable=True) as attached:
        attached.write({"panel/trouble": 2})
        until(lambda: cell.processes()["tank"]["note"] == "a cycle takes longer than 1 s", "the note")
        until(lambda: quality(cell) == "bad", "the frame is too old")
        assert "stale" in reason(cell)
        assert quality(cell, "panel") == "good"
        attached.write({"panel/trouble": 0})
        assert cell.supervisor("restart", "tank").returncode == 0
        until(lambda: quality(cell) == "good", "it runs again")
