"""The laboratory: steps, writes, injections, faults and refusals. The system test compares it with an instance."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from shmio.campaigns.live import Plan as RunPlan
from shmio.config import Expectation
from shmio.config.campaign import parse_campaign
from shmio.errors import CommandError, ConfigError, DeclarationError, TimeError
from shmio.lab import Laboratory, prepare_laboratory
from shmio.model.values import OutcomeKind
from shmio.plan.processes import Plan
from shmio.recording.dump import open_dump
from shmio.segment import instances

SECTIONS = """
[instance]
name = "lab-test"

[[source]]
name = "lift"
connector = "simulation"
model = "lab_lift:Lift"
period_ms = 20
writable = ["speed"]
connections = { factor = "panel/Factor" }

[[source]]
name = "panel"
connector = "memory"
layout = "panel.db"
writable = ["**"]

[grpc]
listen = ["127.0.0.1:0"]
"""
PANEL = 'DATA_BLOCK "panel"\nSTRUCT\n  Factor : REAL := 1.0;\n  Go : BOOL;\nEND_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n'
MODEL = """
from shmio.simulation import Input, Model, Output, Parameter

class Lift(Model):
    speed = Input("LREAL", initial=1.0)
    factor = Input("LREAL", initial=1.0)
    height = Output("LREAL")
    top = Parameter("LREAL", initial=100.0)

    def step(self, time_s, dt_s):
        if self.height > self.top:
            self.height = 0.0
            raise ValueError("over the top")
        self.height += self.speed * self.factor * dt_s
"""


@pytest.fixture
def prepare(tmp_path: Path) -> Callable[..., Plan]:
    (tmp_path / "lab_lift.py").write_text(MODEL)
    (tmp_path / "panel.db").write_text(PANEL)

    def prepared(sections: str = SECTIONS) -> Plan:
        (tmp_path / "supervisor.toml").write_text(sections)
        return prepare_laboratory(tmp_path / "supervisor.toml")

    return prepared


def test_no_folder_of_logs_or_recordings_is_needed(prepare: Callable[..., Plan], tmp_path: Path) -> None:
    (tmp_path / "logs").touch()  # in place of the folder
    prepare(f'{SECTIONS}\n[recorder]\ndirectory = "logs"\n')


def test_steps_writes_and_connections(prepare: Callable[..., Plan]) -> None:
    with Laboratory(prepare()) as lab, lab.attach() as cell:
        assert cell["lift/height"] == 0
        assert cell.step(0.5, 2).time_ns == 1_000_000_000
        assert cell["lift/height"] == 1
        assert [one.kind for one in cell.write({"lift/speed": 2.0})] == [OutcomeKind.WRITTEN]
        assert [one.kind for one in cell.write({"panel/Factor": 3.0})] == [OutcomeKind.WRITTEN]
        assert cell["panel/Factor"] == 3, "a memory shows a written value at once"
        cell.step(0.5)
        assert cell["lift/height"] == 4
        with pytest.raises(CommandError, match="writable"):
            cell.write({"lift/height": 1.0})
        with pytest.raises(TimeError, match="clock"):
            cell.release()
        assert "lab-test" not in instances()


def test_shadows_and_declared_injections(prepare: Callable[..., Plan]) -> None:
    with Laboratory(prepare()) as lab, lab.attach() as cell:
        with cell.inject("panel/Factor") as shadow:
            shadow.set({"Factor": 10.0})
            cell.step(1, 2)
            assert cell["lift/height"] == 20, "a connection delivers what consumers see"
        declared = {"name": "late", "target": "lift/height", "operation": "set", "value": -1, "start_s": 3}
        with cell.declare([declared]):
            cell.step(0.5)
            assert cell["lift/height"] == 20.5
            cell.step(0.5)
            assert cell["lift/height"] == -1
        assert not cell.injections()
        with pytest.raises(DeclarationError, match="nothing"):
            cell.declare([declared | {"target": "lift/nothing"}])


def test_delayed_writes_arrive_together_in_their_step(prepare: Callable[..., Plan]) -> None:
    with Laboratory(prepare()) as lab, lab.attach() as cell:
        declared = {"name": "d", "target": ["panel/Factor/in", "panel/Go/in"], "operation": "delay", "delay_cycles": 2}
        with cell.declare([declared]):
            cell.step(0.02)
            outcomes = cell.write({"panel/Factor": 7.0, "panel/Go": True})
            assert {one.kind for one in outcomes} == {OutcomeKind.TAKEN}
            ring = cell.block("panel").ring
            frames = ring.head()
            cell.step(0.02, 2)
            assert cell["panel/Factor"] == 1
            cell.step(0.02)
            assert (cell["panel/Factor"], cell["panel/Go"]) == (7, True)
            assert ring.head() - frames == 3, "one frame for each step"


def test_writes_of_another_thread_wait_for_the_step(prepare: Callable[..., Plan]) -> None:
    with Laboratory(prepare()) as lab, lab.attach() as cell, lab.attach() as other:
        over = threading.Event()
        outcomes: list[OutcomeKind] = []

        def write() -> None:
            value = 0.0
            while not over.is_set():
                value = 1 - value
                outcomes.extend(one.kind for one in other.write({"lift/speed": value}))

        thread = threading.Thread(target=write)
        thread.start()
        try:
            assert cell.step(0.02, 500).step == 500
        finally:
            over.set()
            thread.join()
        assert outcomes
        assert set(outcomes) == {OutcomeKind.WRITTEN}


def test_a_failing_model_fails_its_step_only(prepare: Callable[..., Plan]) -> None:
    with Laboratory(prepare(), {"lift": {"top": 1.0}}) as lab, lab.attach() as cell:
        cell.step(1, 2)
        with pytest.raises(TimeError, match=r"step 3: lift: .*over the top"):
            cell.step(1)
        assert "over the top" in cell.clock.note
        assert "over the top" in cell.read("lift/height").reason
        with pytest.raises(TimeError, match="over the top"):
            cell.step(1)


def test_a_campaign_repeats_and_leaves_nothing(prepare: Callable[..., Plan], tmp_path: Path) -> None:
    plan = prepare()
    injections = parse_campaign(
        {"injection": [{"name": "n", "target": "lift/height", "operation": "noise", "amplitude": 0.5, "seed": 1}]}
    )
    expectations = [Expectation(name="low", always="lift/height < 0.9")]
    before = set(threading.enumerate())
    found = []
    for name in ("one.mem", "two.mem"):
        with Laboratory(plan) as lab:
            run = lab.run(RunPlan(injections, expectations, 1.0, record=tmp_path / name))
        assert run.problem is None
        (verdict,) = run.judge.verdicts
        with open_dump(tmp_path / name) as dump:
            frames = [entry.item._replace(publish_ns=0) for entry in dump.frames("lift")]
        found.append((verdict.outcome, verdict.robustness, verdict.moment_ns, frames))
    assert found[0] == found[1]
    assert str(found[0][0]) == "failed"
    assert len(found[0][3]) == 50
    assert set(threading.enumerate()) <= before


def test_parameters_are_those_of_models(prepare: Callable[..., Plan]) -> None:
    plan = prepare()
    with pytest.raises(ConfigError, match=r"unknown source 'crane'; did you mean 'panel'\?$"):
        Laboratory(plan, {"crane": {}})
    with pytest.raises(ConfigError, match=r"unknown parameter 'topp' of model Lift; did you mean 'top'\?$"):
        Laboratory(plan, {"lift": {"topp": 1}})
    assert all("commands of" not in one.name for one in threading.enumerate())


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ('connector = "s7"\nlayout = "panel.db"\ndbNumber = 1\nhost = "127.0.0.1"', "s7"),
        ('connector = "remote"\nlayout = "panel.db"\noutputs = ["Factor"]', "remote"),
    ],
)
def test_a_source_that_is_not_computed_here_is_refused_by_name(
    prepare: Callable[..., Plan], source: str, name: str
) -> None:
    sections = f'[instance]\nname = "lab-test"\n[[source]]\nname = "plc"\n{source}\n'
    with pytest.raises(ConfigError, match=f"source 'plc' has connector = \"{name}\".*shmio-campaign run"):
        prepare(sections)
