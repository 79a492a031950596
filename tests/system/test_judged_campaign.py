"""``shmio-campaign``: the same verdicts live in real time, in virtual time, and over the recordings."""

from __future__ import annotations

import json
import os
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import shmio
from shmio.segment import Segment, stale_segment
from shmio.testing.cell import BIN, Cell, kill, until

CONFIG = """
[instance]
name = "{{instance}}"
clock = "{clock}"

[[source]]
name = "cell"
connector = "simulation"
model = "shmio.simulation.a50:A50Cell"
layout = "db201.db"
period_ms = 20

[[source]]
name = "slow"
connector = "simulation"
model = "ramp:Ramp"
period_ms = 50
"""
RAMP = """
from shmio.simulation import Model, Output

class Ramp(Model):
    height = Output("LREAL")

    def step(self, time_s, dt_s):
        self.height += 2 * dt_s
"""
CAMPAIGN = """
duration_s = 4

[[injection]]
name = "offset"
target = "cell/Inputs/200"
operation = "set"
value = 7
start_s = 1
end_s = 2

[[injection]]
name = "noise"
target = "slow/height"
operation = "noise"
amplitude = 0.01

[[expect]]
name = "heartbeat"
formula = "always[0, 2] eventually[0, 1.2] (rise(cell/Outputs/0.%X0) or fall(cell/Outputs/0.%X0))"

[[expect]]
name = "stays"
stays = "cell/Inputs/200 = 7"
for_s = 0.5

[[expect]]
name = "stays-too-long"
stays = "cell/Inputs/200 = 7"
for_s = 1.5
requirement = "R-7"

[[expect]]
name = "answer"
when = "cell/Inputs/200 = 7"
within_s = 1.5
then = "cell/Inputs/200 = 0"

[[expect]]
name = "deadline-after-the-end"
when = "cell/Inputs/200 = 7"
within_s = 60
then = "cell/Outputs/13.%X0"

[[expect]]
name = "never-met"
when = "cell/Outputs/13.%X0"
within_s = 1
then = "cell/Inputs/200 = 7"

[[expect]]
name = "raw"
never = "raw(cell/Inputs/200) != 0"

[[expect]]
name = "fresh"
always = "quality(cell/Inputs/0) = good and age(cell/Inputs/0) < 5"

[[expect]]
name = "rate"
signal = "raw(slow/height)"
max_rate = 1.5
severity = "critical"

[[expect]]
name = "noise"
formula = "always(abs(slow/height - raw(slow/height)) < 0.01) and eventually(slow/height != raw(slow/height))"
"""
OUTCOMES = {
    "heartbeat": "passed",
    "stays": "passed",
    "stays-too-long": "failed",
    "answer": "passed",
    "deadline-after-the-end": "inconclusive",
    "never-met": "inconclusive",
    "raw": "passed",
    "fresh": "passed",
    "rate": "failed",
    "noise": "passed",
}


def prepared(make_cell: Callable[..., Cell], clock: str) -> Cell:
    cell = make_cell(config=CONFIG.format(clock=clock))
    (cell.folder / "ramp.py").write_text(RAMP)
    (cell.folder / "campaign.toml").write_text(CAMPAIGN)
    return cell


def judged(cell: Cell, *words: str) -> dict[str, Any]:
    done = cell.run("shmio-campaign", *words, "--json")
    assert done.returncode == 1, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def same(one: dict[str, Any], other: dict[str, Any]) -> None:
    for key in ("begin_s", "end_s", "verdicts"):
        assert one[key] == other[key]
    assert {verdict["name"]: verdict["outcome"] for verdict in one["verdicts"]} == OUTCOMES


def test_virtual_time_and_recording_agree_and_repeat(make_cell: Callable[..., Cell]) -> None:
    cell = prepared(make_cell, "stepped")
    words = ("run", "campaign.toml", "-c", "supervisor.toml", "--seed", "3")
    live = judged(cell, *words, "--record", "one.mem", "--report", "out.html", "--junit", "out.xml")
    assert live["virtual"]
    same(live, judged(cell, "judge", "one.mem", "-f", "campaign.toml"))
    same(live, judged(cell, *live["command"].split()[1:], "--record", "two.mem"))
    cell.output("shmio-dump", "diff", "one.mem", "two.mem", "--ignore", "times")
    assert "no instance" in cell.run("shmio", "list", "-c", "supervisor.toml").stderr, "the run has stopped it"

    moments = {verdict["name"]: verdict["moment_s"] for verdict in live["verdicts"]}
    assert moments["stays-too-long"] == 1
    page = (cell.folder / "out.html").read_text()
    assert page.count("<svg") == page.count("injection offset on cell") == 14, "a plot for each signal"
    assert "failed at 1.000 s" in page
    assert live["command"] in page
    assert page.count("<td>3<td>") == 2, "the table of injections has the seed of both"
    suite = ET.parse(cell.folder / "out.xml").getroot()
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("10", "2", "2")


def test_real_time_and_recording_agree_on_the_same_verdicts(make_cell: Callable[..., Cell]) -> None:
    cell = prepared(make_cell, "wall")
    cell.up()
    live = judged(cell, "run", "campaign.toml", "--instance", cell.instance, "--real-time", "--record", "one.mem")
    assert not live["virtual"]
    same(live, judged(cell, "judge", "one.mem", "-f", "campaign.toml"))
    told = cell.run("shmio-campaign", "run", "campaign.toml", "--for", "1").stderr
    assert ", virtual time, steps of 20 ms; the instance was already running\n" in told
    status = cell.run("shmio-campaign", "run", "campaign.toml", "--for", "3", "--stop", "--json")
    stopped = json.loads(status.stdout)
    assert stopped["virtual"]
    assert stopped["end_s"] - stopped["begin_s"] < 2.6, "it stopped at the first failure"
    assert json.loads(cell.output("shmio-supervisor", "status", "--json"))["clock"]["mode"] == "wall", "released"
    assert cell.run("shmio-campaign", "run", "campaign.toml", "--record", "one.mem").returncode == 2
    cell.down()


def test_a_run_judges_what_it_has_seen_when_the_supervisor_dies(make_cell: Callable[..., Cell]) -> None:
    cell = prepared(make_cell, "wall")
    (cell.folder / "low.toml").write_text('[[expect]]\nname = "low"\nnever = "slow/height >= 0"\n')
    words = ("run", "low.toml", "-c", "supervisor.toml", "--real-time", "--for", "100")
    with subprocess.Popen(
        [BIN / "shmio-campaign", *words, "--report", "out.html", "--junit", "out.xml", "--record", "out.mem"],
        cwd=cell.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as run:  # fmt: skip
        assert run.stderr is not None
        head = run.stderr.readline()
        assert "1 expectation," in head
        assert head.endswith(", real time; the instance was started for this run\n")
        with shmio.attach(cell.instance) as seen:
            for _ in range(2):  # the run has begun, so it sees at least the second one
                assert seen.wait("slow", timeout_s=60)
        with Segment.open(cell.instance) as segment:
            kill(segment.supervisor[0])
        out, errors = run.communicate(timeout=120)
    assert run.returncode == 1, errors
    assert out.startswith("failed ")
    assert f"the run ended early: the supervisor of instance '{cell.instance}' has died\n" in errors
    assert "stopped slow, pid" in errors
    assert "no instance" in cell.run("shmio", "list", "-c", "supervisor.toml").stderr
    assert (cell.folder / "out.html").exists()
    assert (cell.folder / "out.xml").exists()
    assert cell.run("shmio-campaign", "judge", "out.mem", "-f", "low.toml").returncode == 1


HANGING = """
from pathlib import Path

from shmio.simulation import Model, Output

class Ramp(Model):
    height = Output("LREAL")

    def start(self):
        Path("hang").read_bytes()  # a FIFO

    def step(self, time_s, dt_s):
        pass
"""


def test_a_run_clears_the_instance_whose_supervisor_dies_while_it_starts(make_cell: Callable[..., Cell]) -> None:
    cell = prepared(make_cell, "wall")
    (cell.folder / "ramp.py").write_text(HANGING)
    os.mkfifo(cell.folder / "hang")
    with subprocess.Popen(
        [BIN / "shmio-campaign", "run", "campaign.toml", "-c", "supervisor.toml"],
        cwd=cell.folder, stderr=subprocess.PIPE, text=True,
    ) as run:  # fmt: skip
        until(lambda: run.poll() is not None or stale_segment.living(cell.instance), "a process of the instance runs")
        with Segment.open(cell.instance) as segment:
            kill(segment.supervisor[0])
        errors = run.communicate(timeout=120)[1]
    assert run.returncode == 3, errors
    assert "the supervisor died while it started" in errors
    assert ", which had lost its supervisor\nremoved the left-over segment" in errors
    assert "no instance" in cell.run("shmio", "list", "-c", "supervisor.toml").stderr
