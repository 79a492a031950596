"""A laboratory's recording is that of an instance, byte for byte."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from shmio.campaigns.live import LiveRun, Plan
from shmio.config.campaign import CampaignFile
from shmio.config.declaration import with_seed
from shmio.lab import Laboratory, prepare_laboratory
from shmio.recording.compare import Comparison, compare
from shmio.recording.dump import open_dump
from shmio.segment import Event, Frame
from shmio.testing.cell import Cell

CONFIG = """
[instance]
name = "{instance}"
clock = "stepped"

[[source]]
name = "cell"
connector = "simulation"
model = "shmio.simulation.a50:A50Cell"
layout = "db201.db"
period_ms = 20

[[source]]
name = "tank"
connector = "simulation"
model = "tank:Tank"
period_ms = 50
parameters = {{ rate = 3.0 }}
seed = 5
connections = {{ valve = "cell/Robot_800/Axs1_Pos" }}

[[source]]
name = "panel"
connector = "memory"
layout = "panel.db"

[[injection]]
name = "configured"
target = "tank/level"
operation = "noise"
amplitude = 0.5
seed = 9
start_s = 0.5
end_s = 1.5
"""
PANEL = """
DATA_BLOCK "panel"
STRUCT
  Speed : REAL := 1.5;
  Go : BOOL := TRUE;
END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
TANK = """
from shmio.simulation import Input, Model, Output, Parameter

class Tank(Model):
    valve = Input("LREAL")
    level = Output("LREAL")
    rate = Parameter("LREAL", initial=1.0)

    def step(self, time_s, dt_s):
        if time_s > 3.2:
            raise ValueError("the tank has burst")
        self.level += (self.rate + 0.001 * self.valve + self.random.random()) * dt_s
"""
CAMPAIGN = """
duration_s = 4

[[injection]]
name = "conditional"
target = "cell/Robot_800/Axs1_Pos"
operation = "offset"
value = 25
when = "tank/level > 2"
for_s = 0.3
times = 2

[[injection]]
name = "noise"
target = "cell/Robot_800/Axs*_Pos"
operation = "noise"
amplitude = 0.01
distribution = "gaussian"
probability = 0.5

[[injection]]
name = "late"
target = "panel/Speed"
operation = "random"
min = 0
max = 1
start_s = 1

[[injection]]
name = "delayed"
target = "tank/level"
operation = "delay"
delay_ms = 100
end_s = 2

[[injection]]
name = "bit"
target = "panel/Go"
operation = "flip"
when = "rising(tank/level > 1)"
for_s = 0.1

[[expect]]
name = "level"
always = "tank/level < 100"

[[expect]]
name = "answer"
when = "panel/Speed < 0.5"
within_s = 1
then = "panel/Speed > 0.5"

[[expect]]
name = "hidden"
never = "raw(panel/Speed) != 1.5"
"""


def in_laboratory(folder: Path, recording: Path, seed: int) -> LiveRun:
    campaign = CampaignFile(folder / "campaign.toml").at({})
    assert campaign.duration_s is not None
    plan = Plan(
        [with_seed(one, seed) for one in campaign.injection], campaign.expect, campaign.duration_s, record=recording
    )
    with Laboratory(prepare_laboratory(folder / "supervisor.toml")) as lab:
        return lab.run(plan)


def contents(file: Path) -> list[Frame | Event]:
    """Return all that a recording has, without what can differ between two runs of an instance.

    These are the host's clock, the numbers of commands, which begin with it, and their senders, which are processes.
    """
    with open_dump(file) as dump:
        frames = [entry.item._replace(publish_ns=0) for source in dump.sources for entry in dump.frames(source)]
        events = [
            entry.item._replace(publish_ns=0, command=0, injection=0, by="")
            for source in dump.sources
            for entry in dump.events(source)
        ]
    return [*frames, *events]


def test_the_recording_is_that_of_an_instance(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=CONFIG)
    folder = cell.folder
    for name, text in (("tank.py", TANK), ("panel.db", PANEL), ("campaign.toml", CAMPAIGN)):
        (folder / name).write_text(text)
    done = cell.run(
        "shmio-campaign", "run", "campaign.toml", "-c", "supervisor.toml", "--seed", "3",
        "--record", "instance.mem", "--json",
    )  # fmt: skip
    assert "the tank has burst" in done.stderr, done.stderr + done.stdout
    run = in_laboratory(folder, folder / "lab.mem", 3)
    assert "the tank has burst" in str(run.problem)
    found = {one.expectation.name: [str(one.outcome), one.reason, one.robustness] for one in run.judge.verdicts}
    told = {
        one["name"]: [one["outcome"], one["reason"], one["robustness"]] for one in json.loads(done.stdout)["verdicts"]
    }
    assert found == told
    with open_dump(folder / "instance.mem") as one, open_dump(folder / "lab.mem") as other:
        differences = list(compare(one, other, Comparison()))
    assert [(found.source, found.same, found.events.compared > 0) for found in differences] == [
        ("cell", True, True), ("tank", True, True), ("panel", True, True),
    ]  # fmt: skip
    here, there = contents(folder / "lab.mem"), contents(folder / "instance.mem")
    assert len(here) > 480
    assert here == there
    assert any(isinstance(item, Frame) and item.effective is not None for item in here)
    in_laboratory(folder, folder / "other.mem", 4)
    assert contents(folder / "other.mem") != here, "another seed gives another recording"
