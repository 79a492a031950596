"""Virtual time in an instance with a user's models: stepped by commands and by programs."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

import shmio
from shmio.errors import TimeError
from shmio.local.attach import Attachment
from shmio.local.time_control import Coordinator
from shmio.segment import Segment
from shmio.testing.cell import BIN, PATIENCE_S, Cell, kill, until

CONFIG = """
[instance]
name = "{instance}"
clock = "CLOCK"

[[source]]
name = "belt"
connector = "simulation"
model = "line:Belt"
parameters = {{ gain = 2.0 }}
writable = ["speed"]

[[source]]
name = "gate"
connector = "simulation"
model = "line:Gate"
period_ms = 7
writable = ["**"]
[source.connections]
position = "belt/position"
limit = "panel/limit"

[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
writable = ["**"]

[grpc]
listen = ["{grpc}"]
"""
MODELS = '''
import time

from shmio.simulation import Input, Model, Output, Parameter


class Belt(Model):
    """Moves at its speed."""

    gain = Parameter("LREAL", 1.0)
    speed = Input("LREAL", 1.0)
    position = Output("LREAL")

    def step(self, time_s, dt_s):
        if self.speed < 0:
            raise ValueError("the belt cannot run backward")
        if self.speed > 1000:
            time.sleep(3600)
        self.position += self.gain * self.speed * dt_s


class Gate(Model):
    """Closed while the belt was beyond the limit a step ago."""

    position = Input("LREAL")
    limit = Input("LREAL", 1e9)
    closed = Output("BOOL")

    def step(self, time_s, dt_s):
        self.closed = self.position > self.limit
'''


def start(make: Callable[..., Cell], clock: str) -> Cell:
    """Start an instance with two models and a memory."""
    cell = make(config=CONFIG.replace("CLOCK", clock))
    (cell.folder / "line.py").write_text(MODELS)
    (cell.folder / "panel.toml").write_text('[registers]\nlimit = { type = "LREAL", initial = 0.25 }\n')
    cell.up()
    until(
        lambda: all(cell.processes()[name]["quality"] == "good" for name in ("belt", "gate", "panel")), "good quality"
    )
    return cell


@pytest.fixture
def make_line(make_cell: Callable[..., Cell]) -> Callable[[str], Cell]:
    """Return a function that starts an instance for one test."""
    return partial(start, make_cell)


@pytest.fixture(scope="module")
def shared_line(make_shared_cell: Callable[..., Cell]) -> Cell:
    return start(make_shared_cell, "stepped")


@pytest.fixture
def line(shared_line: Cell) -> Cell:
    """Return an instance whose time is stopped. From the next step on, the belt's speed is 1."""
    with shmio.attach(shared_line.instance, writable=True) as cell:
        cell.write({"belt/speed": 1.0})
        cell.step()
    return shared_line


def step(cell: Cell, *arguments: str) -> dict[str, Any]:
    done = cell.run("shmio", "step", "--json", *arguments)
    assert done.returncode == 0, done.stderr
    clock: dict[str, Any] = json.loads(done.stdout)
    return clock


def get(cell: Cell, *paths: str) -> list[Any]:
    shown = json.loads(cell.output("shmio", "get", "--json", *paths))
    assert {reading["quality"] for reading in shown.values()} == {"good"}, shown
    return [shown[path]["value"] for path in paths]


def test_the_step_command_steps_and_prints_the_time(make_line: Callable[[str], Cell]) -> None:
    line = make_line("stepped")
    assert get(line, "belt/position", "gate/closed") == [0.0, False]
    clock = step(line)
    assert (clock["mode"], clock["step"], clock["time_s"], clock["step_size_ms"]) == ("virtual", 1, 0.05, 50)
    assert get(line, "belt/position", "gate/closed") == [0.1, False]
    assert step(line, "--dt-ms", "100")["time_s"] == 0.15
    assert get(line, "belt/position", "gate/closed") == [pytest.approx(0.3), False], (
        "the gate sees the belt of the previous step"
    )
    step(line)
    assert get(line, "belt/position", "gate/closed") == [pytest.approx(0.4), True]
    assert line.run("shmio", "set", "belt/speed", "0.5", "panel/limit", "3").returncode == 0
    assert get(line, "panel/limit") == [3.0]
    assert step(line, "--count", "3")["step"] == 6
    assert get(line, "belt/position", "gate/closed") == [pytest.approx(0.55), False]
    assert line.output("shmio", "step") == "virtual time 0.400 s, step 7, steps of 50 ms\n"
    assert "virtual time 0.400 s, step 7, steps of 50 ms" in line.supervisor("status").stdout
    assert line.status()["clock"]["time_s"] == 0.4


def test_wall_time_runs_until_a_program_takes_control(make_line: Callable[[str], Cell]) -> None:
    line = make_line("wall")
    assert line.status()["clock"]["mode"] == "wall"
    first = line.processes()["belt"]["cycle"]
    until(lambda: line.processes()["belt"]["cycle"] > first + 5, "the belt runs")
    clock = step(line, "--pause")
    assert clock["mode"] == "virtual"
    before = get(line, "belt/position")
    assert step(line)["step"] == clock["step"] + 1
    assert get(line, "belt/position") == [pytest.approx(before[0] + 0.1)]


def test_time_can_be_released_and_taken_again(make_line: Callable[[str], Cell]) -> None:
    line = make_line("wall")

    def runs() -> None:
        [before], cycle = get(line, "belt/position"), line.processes()["belt"]["cycle"]
        until(lambda: line.processes()["belt"]["cycle"] > cycle + 3, "the belt runs by itself")
        assert get(line, "belt/position")[0] > before

    moments = []
    with shmio.attach(line.instance) as cell:
        followed = [cell.block(source).cursor() for source in ("belt", "gate", "panel")]
        for way in ((), ("--host", str(line.grpc))):
            # Run ahead of real time by a number of steps, and then by time.
            moments += [step(line, *way, "--dt-ms", dt_ms, "--count", "30") for dt_ms in ("1", "60000")]
            moments.append(step(line, *way, "--release"))
            assert moments[-1]["mode"] == "wall"
            runs()
        pid = line.processes()["belt"]["pid"]
        kill(pid)
        until(lambda: line.processes()["belt"]["pid"] not in (None, pid), "its process is replaced")
        runs()
        for cursor in followed:
            told = [(frame.cycle, frame.clock_ns) for frame in iter(cursor.poll, None)]
            assert told == sorted(told), "cycles and time never decrease"
    times = [moment["time_s"] for moment in moments]
    assert times == sorted(times)


def test_play_runs_until_ctrl_c(line: Cell) -> None:
    begun_s = line.status()["clock"]["time_s"]
    with subprocess.Popen([BIN / "shmio", "step", "--play", "10"], cwd=line.folder, stdout=subprocess.PIPE) as player:
        try:
            until(lambda: line.status()["clock"]["time_s"] > begun_s + 1, "time runs")
            refused = line.run("shmio", "step")
            assert refused.returncode == 1
            assert f"another program (pid {player.pid}), which is playing it" in refused.stderr
            player.send_signal(signal.SIGINT)
            assert player.wait(PATIENCE_S) == 0
        finally:
            player.kill()
    clock = line.status()["clock"]
    assert not clock["playing"]
    assert step(line)["step"] == clock["step"] + 1


def test_time_that_started_virtual_cannot_be_released(line: Cell) -> None:
    told = [line.run("shmio", "step", "--release", *way).stderr for way in ((), ("--host", str(line.grpc)))]
    assert all('because its configuration says clock = "stepped"' in one for one in told)
    assert step(line)["mode"] == "virtual"


def test_a_program_steps_and_plays(line: Cell) -> None:
    with shmio.attach(line.instance, writable=True) as cell:
        begun = cell.clock
        assert not begun.playing
        made = cell.step(dt_s=0.02)
        assert (made.step, made.time_ns) == (begun.step + 1, begun.time_ns + 20_000_000)
        cell.play(50)
        with pytest.raises(TimeError, match="pause it"):
            cell.step()
        while cell.clock.time_ns < begun.time_ns + 500_000_000:
            cell.wait("belt", timeout_s=PATIENCE_S)
        cell.pause()
        stands = cell.clock
        assert not stands.playing
        assert cell.step().step == stands.step + 1
    with shmio.attach(line.instance) as reader, pytest.raises(TimeError, match="writable=True"):
        reader.step()


def test_an_exception_in_a_model_fails_the_step_and_names_the_line(line: Cell) -> None:
    [position], number = get(line, "belt/position"), line.status()["clock"]["step"] + 1
    line.run("shmio", "set", "belt/speed", "-1")
    failed = line.run("shmio", "step")
    assert failed.returncode == 1
    assert failed.stderr == (
        f"step {number}: belt: model line:Belt: ValueError: the belt cannot run backward (line.py, line 16)\n"
    )
    belt = line.processes()["belt"]
    assert (belt["quality"], belt["cycle"]) == ("bad", number)
    assert "the belt cannot run backward" in belt["reason"]
    assert f"step {number} failed: belt: " in line.status()["clock"]["note"]
    line.run("shmio", "set", "belt/speed", "1")
    assert step(line)["step"] == number + 1
    assert get(line, "belt/position") == [pytest.approx(position + 0.1)]


def test_a_failed_step_gives_the_same_messages_locally_and_by_grpc(line: Cell) -> None:
    ways: tuple[tuple[str, ...], ...] = (), ("--host", str(line.grpc))
    number = line.status()["clock"]["step"]
    line.run("shmio", "set", "belt/speed", "-1")
    failed = [line.run("shmio", "step", "--count", "2", *way) for way in ways]
    assert [(done.returncode, done.stdout) for done in failed] == [(1, "")] * 2
    first, second = (done.stderr.partition(": ") for done in failed)
    assert (first[0], second[0], first[2]) == (f"step {number + 1}", f"step {number + 2}", second[2])
    on_host, by_grpc = (step(line, "--pause", *way) for way in ways)
    assert on_host == by_grpc
    assert on_host["step"] == number, "the last step that all sources have finished"
    assert on_host["note"].startswith(f"step {number + 2} failed: belt: ")


def test_the_step_command_prints_the_step_size_and_refuses_conflicting_options(line: Cell) -> None:
    told = line.output("shmio", "step", "--dt-ms", "20", "--count", "2")
    assert re.fullmatch(r"virtual time [0-9.]+ s, step [0-9]+ of 20 ms, step size 50 ms\n", told), told
    refused = line.run("shmio", "step", "--pause", "--dt-ms", "20")
    assert (refused.returncode, refused.stderr) == (1, "--pause does no step; leave out --dt-ms\n")
    refused = line.run("shmio", "step", "--play", "--count", "2")
    assert (refused.returncode, "--count: not allowed with argument --play" in refused.stderr) == (2, True)


@pytest.mark.parametrize("remote", [False, True])
def test_a_computed_register_cannot_be_set_and_the_remedy_works(line: Cell, remote: bool) -> None:
    way = ("--host", str(line.grpc)) if remote else ()
    unlisted = line.run("shmio", "set", *way, "belt/position", "7").stderr
    assert unlisted.startswith("belt/position is not writable; ")
    assert unlisted.endswith("unless its model computes it: then only shmio inject can show another value\n")
    listed = line.run("shmio", "set", *way, "gate/closed", "true").stderr
    assert listed == (
        "gate/closed: the source refused the write: the model computes closed: outputs cannot be written; "
        "shmio inject can show another value\n"
    )
    laid = line.run("shmio", "inject", *way, "--keep", "belt/position", "-7")
    assert laid.returncode == 0, laid.stderr
    assert get(line, "belt/position") == [-7.0]
    assert line.run("shmio", "inject", *way, "--lift-all").returncode == 0
    assert get(line, "belt/position") != [-7.0]


def test_a_model_killed_during_a_step_fails_it_and_the_next_step_works(line: Cell) -> None:
    with Attachment(Segment.open(line.instance, writable=True)) as cell:
        [position], number = get(line, "belt/position"), cell.clock.step + 1
        cell.write({"belt/speed": 5000.0})
        pid = line.processes()["belt"]["pid"]
        with subprocess.Popen([BIN / "shmio", "step"], cwd=line.folder, stderr=subprocess.PIPE, text=True) as command:
            until(lambda: "waits for belt" in cell.clock.note, "the step waits")
            kill(pid)
            _, error = command.communicate(timeout=PATIENCE_S)
        assert command.returncode == 1
        assert error == (
            f"step {number}: belt: the source's process was restarted during this step; "
            "it continues with the next step (killed by SIGKILL)\n"
        )
        cell.write({"belt/speed": 1.0})
        assert cell.step().step == number + 1
        assert cell["belt/position"] == pytest.approx(position + 0.1)


def test_a_frozen_model_is_named_after_the_hard_time_out(line: Cell) -> None:
    [position], number = get(line, "belt/position"), line.status()["clock"]["step"] + 1
    pid = line.processes()["gate"]["pid"]
    with Segment.open(line.instance, writable=True) as segment:
        coordinator = Coordinator(segment, soft_s=0.05, hard_s=0.1)
        kill(pid, signal.SIGSTOP)
        try:
            with pytest.raises(TimeError, match=rf"^step {number}: gate: no answer within 0.1 s from pid {pid}$"):
                coordinator.step()
        finally:
            kill(pid, signal.SIGCONT)
        coordinator.close()
    assert step(line)["step"] == number + 1
    assert get(line, "belt/position") == [pytest.approx(position + 0.2)]


def test_time_stops_when_the_program_that_plays_is_killed(line: Cell) -> None:
    playing = "import shmio, sys, time; cell = shmio.attach(sys.argv[1], writable=True); cell.play(); time.sleep(3600)"
    with subprocess.Popen([sys.executable, "-c", playing, line.instance]) as player:
        until(lambda: line.status()["clock"]["playing"], "time plays")
        begun = line.status()["clock"]["step"]
        until(lambda: line.status()["clock"]["step"] > begun + 3, "time runs")
        player.kill()
    stands = line.status()["clock"]
    assert not stands["playing"], "no program plays time any more"
    clock = step(line)
    assert clock["step"] in (stands["step"] + 1, stands["step"] + 2), "it may have been killed during a step"
    assert not clock["playing"]


def test_a_take_over_keeps_the_time_unless_the_configured_clock_changed(
    make_line: Callable[[str], Cell],
) -> None:
    line = make_line("wall")
    file = line.folder / "supervisor.toml"

    def up_again(clock: str | None = None) -> str:
        kill(line.status()["supervisor"]["pid"])
        if clock:
            file.write_text(re.sub('clock = ".*"', f'clock = "{clock}"', file.read_text()))
        return line.supervisor("up", "--detach").stdout

    taken_over = step(line)["step"]
    assert "took over belt" in up_again(), "its configuration has the wall clock, though time is virtual"
    assert step(line)["step"] == taken_over + 1
    assert f"{line.instance} was started with instance.clock wall, not stepped; stopping the old processes" in up_again(
        "stepped"
    )
    assert line.status()["clock"]["step"] == 0
    assert step(line, "--count", "3")["step"] == 3
    assert "took over belt" in up_again()
    assert step(line)["step"] == 4
    assert "with instance.clock stepped, not wall; stopping the old processes" in up_again("wall")
    assert line.status()["clock"]["mode"] == "wall"
