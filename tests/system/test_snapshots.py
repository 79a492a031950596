"""Snapshots of an instance with a model, an FMU, a PLC program on an emulator, and injections."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from typing import Any

import pytest

import shmio
from shmio.errors import SnapshotError, TimeError
from shmio.lab import Laboratory, prepare_laboratory
from shmio.local.attach import Attachment
from shmio.recording.dump import open_dump
from shmio.testing.cell import Cell, kill, until
from tests.fmus import build

SIMULATED = """
[instance]
name = "{instance}"
clock = "stepped"

[[source]]
name = "tank"
connector = "simulation"
model = "tank2.fmu"
period_ms = 20
[source.connections]
"pump.inflow" = "walk/flow"

[[source]]
name = "walk"
connector = "simulation"
model = "snapshot_line:Walk"
period_ms = 20

[[injection]]
name = "noise"
target = "tank/level"
operation = "noise"
amplitude = 0.01
when = "walk/flow > 0.5"
for_s = 0.1

[[injection]]
name = "late"
target = "walk/flow"
operation = "delay"
delay_ms = 60
"""
CONFIG = (
    SIMULATED
    + """
[[source]]
name = "plc-line"
connector = "s7"
layout = "line.toml"
host = "127.0.0.1"
port = {plc.port}
writable = ["run"]

[[emulator]]
name = "plc"
kind = "s7"
program = "snapshot_line:Line"
clock = "instance"
listen = "{plc}"

[grpc]
listen = ["{grpc}"]

[recorder]
directory = "dumps"
"""
)
MODELS = """
from shmio.plc import Input as In, Output as Out, Program, TON
from shmio.simulation import Model, Output

class Walk(Model):
    flow = Output("LREAL")

    def start(self):
        self.speed = 0.0

    def step(self, time_s, dt_s):
        self.speed += self.random.normal() * dt_s
        self.flow = min(max(self.flow + self.speed, 0.0), 1.0)

class Line(Program):
    run = In("BOOL", True)
    lamp = Out("BOOL")
    starts = Out("INT")
    scans = Out("INT")
    started = TON(0.1)

    def start(self):
        self.seen = [0]

    def scan(self, time_s, dt_s):
        was = self.lamp
        self.lamp = self.started(self.run and self.seen[0] % 17 != 0)
        self.starts += self.lamp and not was
        self.seen[0] += 1
        self.scans = self.seen[0]
"""
TAGS = """
[registers]
run = { type = "BOOL", address = "DB1.DBX0.0", writable = true }
lamp = { type = "BOOL", address = "DB1.DBX0.1" }
starts = { type = "INT", address = "DB1.DBW2" }
scans = { type = "INT", address = "DB1.DBW4" }
"""
STEPPED = ("tank", "walk")


@pytest.fixture
def cell(make_cell: Callable[..., Cell]) -> Cell:
    cell = make_cell(config=CONFIG)
    build("tank2", cell.folder)
    (cell.folder / "snapshot_line.py").write_text(MODELS)
    (cell.folder / "line.toml").write_text(TAGS)
    cell.up()
    until(lambda: cell.processes()["plc-line"]["quality"] == "good", "good quality")
    return cell


class Tap:
    """What the stepped sources publish, and after each step the memory of the controller."""

    def __init__(self, cell: Attachment) -> None:
        self._cell = cell
        self._cursors = [
            (cell.block(one), cell.block(one).cursor(), cell.block(one).events.cursor()) for one in STEPPED
        ]
        self._memory: list[bytes] = []

    def step(self, count: int) -> None:
        for _ in range(count):
            self._cell.step(0.02)
            for _ in range(2):  # the second frame was certainly read after the step
                self._cell.wait("plc-line")
            frame = self._cell.block("plc-line").latest()
            assert frame is not None
            self._memory.append(frame.raw)

    def take(self) -> list[Any]:
        found: list[Any] = list(self._memory)
        for block, frames, events in self._cursors:
            while (frame := frames.poll()) is not None:
                found.append((frame.cycle, frame.publish_ns, frame.source_ns, *frame[6:8], *frame[9:]))
            while (event := events.poll()) is not None:
                found.append((block.source, event.kind, event.cycle, event.clock_ns, event.utc_ns, *event[11:]))
        return found


def test_the_remainder_is_the_same_from_random_moments(cell: Cell) -> None:
    moments = random.Random(3)
    with shmio.attach(cell.instance, writable=True) as attached:
        with pytest.raises(SnapshotError, match=r"plc-line: its device continues in real time.*--partial"):
            attached.save_snapshot("here")
        for _ in range(3):
            Tap(attached).step(moments.randrange(1, 9))
            saved = attached.save_snapshot("here", partial=True)
            assert list(saved.left_out) == ["plc-line"]
            tap = Tap(attached)
            tap.step(12)
            expected = tap.take()
            Tap(attached).step(moments.randrange(1, 5))
            assert attached.restore_snapshot("here") == saved
            tap = Tap(attached)
            tap.step(12)
            assert tap.take() == expected
        assert attached["plc-line/scans"] != 0


def test_commands_and_other_hosts_save_and_restore(cell: Cell) -> None:
    def snapshot(*words: str) -> Any:
        return json.loads(cell.output("shmio", "snapshot", *words, "--json"))

    host = ("--host", str(cell.grpc))
    cell.output("shmio", "step", "--dt-ms", "20", "--count", "10")
    [saved] = snapshot("save", "warm", "--partial")
    assert (saved["step"], saved["time_ns"], list(saved["left_out"])) == (10, 200_000_000, ["plc-line"])
    cell.output("shmio", "step", "--dt-ms", "20", "--count", "30")
    after = cell.output("shmio", "get", "walk", "tank/level")
    with shmio.connect(str(cell.grpc)) as remote, remote.subscribe("walk/flow", every_frame=True) as updates:
        next(updates)
        assert remote.restore_snapshot("warm").left_out == saved["left_out"]
        update = next(updates)
        assert (update.cycle, update.clock_ns) == (10, 200_000_000), "subscribers get the restored values"
        clock = remote.step(0.02, 30)
        assert (clock.step, clock.time_ns) == (40, 800_000_000)
        with pytest.raises(SnapshotError, match="unknown snapshot 'x'"):
            remote.restore_snapshot("x")
    assert cell.output("shmio", "get", "walk", "tank/level") == after
    assert snapshot("list", *host) == [saved]
    assert snapshot("restore", "warm", *host) == [saved]
    lines = cell.output("shmio", "snapshot", "restore", "warm")
    assert "without plc-line" in lines
    snapshot("delete", "warm", *host)
    assert snapshot("list") == []
    assert "list takes no NAME" in cell.run("shmio", "snapshot", "list", "x").stderr
    assert "save needs a NAME" in cell.run("shmio", "snapshot", "save").stderr
    audit = cell.output("shmio-supervisor", "audit")
    for action in ("save snapshot", "restore snapshot", "delete snapshot"):
        assert f"{action} snapshot = warm" in audit
    cell.down()
    files = sorted((cell.folder / "dumps").glob("*.mem"))
    events = [entry.item.kind for file in files for entry in open_dump(file).events("walk")]
    assert {18, 19} <= set(events), "the recording tells of both"
    assert len(files) >= 3, "each restore that sets time back begins a new file"


def test_a_laboratory_restores_what_an_instance_has_saved(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=SIMULATED)
    build("tank2", cell.folder)
    (cell.folder / "snapshot_line.py").write_text(MODELS)
    cell.up()
    with shmio.attach(cell.instance, writable=True) as attached:
        attached.step(0.02, 20)
        attached.save_snapshot("warm")
        frames = attached.block("tank").cursor()
        attached.step(0.02, 20)
        expected = [(frame.clock_ns, frame.raw, frame.effective) for frame in iter(frames.poll, None)]
    cell.down()
    with Laboratory(prepare_laboratory(cell.folder / "supervisor.toml")) as lab, lab.attach() as attached:
        attached.restore_snapshot("warm")
        frames = attached.block("tank").cursor()
        attached.step(0.02, 20)
        assert [(frame.clock_ns, frame.raw, frame.effective) for frame in iter(frames.poll, None)] == expected
        attached.save_snapshot("later")
    cell.up()
    with shmio.attach(cell.instance, writable=True) as attached:
        assert attached.restore_snapshot("later").step == 40
        attached.step(0.02)
        assert attached.clock.time_ns == 820_000_000


def test_owners_of_time_and_dead_processes_are_named(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=SIMULATED.replace('clock = "stepped"', ""))
    build("tank2", cell.folder)
    (cell.folder / "snapshot_line.py").write_text(MODELS)
    cell.up()
    with shmio.attach(cell.instance, writable=True) as attached:
        with pytest.raises(TimeError, match=r"time is real.*shmio step --pause"):
            attached.save_snapshot("old")
        attached.pause()
        begun = attached.save_snapshot("old")
        attached.step(0.02, 5)
        with shmio.attach(cell.instance, writable=True) as other, pytest.raises(TimeError, match="moved by"):
            other.restore_snapshot("old")
        attached.restore_snapshot("old")
        assert attached.clock.time_ns == begun.time_ns
        kill(cell.processes()["walk"]["pid"])
        with pytest.raises(TimeError, match="walk"):
            attached.step(0.02)
        until(lambda: cell.processes()["walk"]["state"] == "running", "a new process")
        attached.restore_snapshot("old")
        attached.step(0.02)
        assert attached.clock.step == begun.step + 1
        released = attached.release()
        assert released.time_ns >= begun.time_ns
        until(lambda: cell.processes()["walk"]["quality"] == "good", "good quality in real time")
