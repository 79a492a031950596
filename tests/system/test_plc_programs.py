"""PLC programs on emulators: on the instance's clock, killed, and with faults on command."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from shmio.control import Answers
from shmio.errors import ControlError
from shmio.local.status import read_status
from shmio.model.values import Quality
from shmio.testing.cell import kill, until
from shmio.testing.cell_under_test import CellUnderTest, running_cell

pytest.importorskip("pymodbus")

HERE = "127.0.0.1"
KINDS = {
    "s7": ("DB1.DBX0.0", "DB1.DBX0.1", "DB1.DBW2", f'host = "{HERE}"\nport = 1102'),
    "modbus": ("coil 0", "coil 1", "holding 2", f'host = "{HERE}"\nport = 1103'),
}
SOURCES = [f"{kind}-line" for kind in KINDS]
PROGRAM = """
from shmio.plc import Input, Output, Program, TON

class Line(Program):
    run = Input("BOOL")
    lamp = Output("BOOL")
    scans = Output("INT")
    started = TON(0.1)

    def scan(self, time_s, dt_s):
        self.lamp = self.started(self.run)
        self.scans = round(time_s * 100)
"""


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[CellUnderTest]:
    plant, own = tmp_path / "plant", tmp_path / "own"
    plant.mkdir()
    own.mkdir()
    (plant / "line.py").write_text(PROGRAM)
    text = '[instance]\nname = "line"\n'
    for port, (kind, (run, lamp, scans, keys)) in enumerate(KINDS.items(), 1102):
        rows: dict[str, dict[str, object]] = {
            "run": {"type": "BOOL", "address": run, "writable": True},
            "lamp": {"type": "BOOL", "address": lamp},
            "scans": {"type": "INT", "address": scans},
        }
        fields = [", ".join(f"{key} = {json.dumps(value)}" for key, value in row.items()) for row in rows.values()]
        tags = "".join(f"{name} = {{ {row} }}\n" for name, row in zip(rows, fields, strict=True))
        (plant / f"{kind}.toml").write_text(f"[registers]\n{tags}")
        text += f"""
[[source]]
name = "{kind}-line"
connector = "{kind}"
layout = "{kind}.toml"
timeout = 300
{keys}
[[emulator]]
name = "{kind}-plc"
kind = "{kind}"
program = "line:Line"
clock = "instance"
faults = true
listen = "127.0.0.1:{port}"
"""
    (plant / "supervisor.toml").write_text(text)
    with running_cell(plant / "supervisor.toml", own, "line") as cell:
        yield cell


def quality(cell: CellUnderTest, kind: str) -> tuple[Quality, str]:
    reading = cell.attachment.read(f"{kind}-line/lamp")
    return reading.quality, reading.reason


def read_again(cell: CellUnderTest) -> None:
    """Wait until all sources show what is in their devices now."""
    for source in SOURCES:
        for _ in range(2):  # the second frame was certainly read after this call
            cell.attachment.wait(source)


def test_a_step_runs_the_scans_that_are_due_on_each_kind_of_emulator(cell: CellUnderTest) -> None:
    attached = cell.attachment
    attached.pause()
    for source in SOURCES:
        cell.write({f"{source}/run": True})
    attached.step(0.01)
    read_again(cell)
    begun = {source: int(str(cell[f"{source}/scans"])) for source in SOURCES}

    def ran(scans: int) -> bool:
        return all(cell[f"{source}/scans"] == begun[source] + scans for source in SOURCES)

    assert attached.clock.note == ""
    attached.step(0.095)  # nine scans, and half of one
    read_again(cell)
    assert ran(9)
    assert not any(cell[f"{source}/lamp"] for source in SOURCES)
    attached.step(0.005)
    read_again(cell)
    assert ran(10)
    assert all(cell[f"{source}/lamp"] for source in SOURCES)

    (pid,) = (one.pid for one in read_status(attached.instance).processes if one.name == "s7-plc")
    assert pid is not None
    kill(pid)
    attached.step(0.01)  # waits for no dead process
    until(lambda: quality(cell, "s7")[0] is Quality.GOOD and cell["s7-line/scans"] in (0, 1), "a new emulator", 30)
    attached.step(0.05)
    until(lambda: cell["s7-line/scans"] in (5, 6), "its scans", 20)  # 6 if it took part in the step before
    attached.release()
    until(lambda: not any(ran(scans) for scans in range(20)), "real time", 20)


FAULTS: dict[Answers, str] = {"refuse": "refused", "hang": "no answer", "delay": "no answer", "corrupt": ""}


def test_an_emulator_disturbs_its_answers_on_command(cell: CellUnderTest) -> None:
    def is_bad(kind: str, reason: str) -> bool:
        found = quality(cell, kind)
        return found[0] is Quality.BAD and reason in found[1]

    def is_good(kind: str) -> bool:
        return quality(cell, kind)[0] is Quality.GOOD

    for kind, other in (("s7", "modbus"), ("modbus", "s7")):
        for answers, reason in FAULTS.items():
            cell.disturb(f"{kind}-plc", answers, 900)
            until(partial(is_bad, kind, reason), f"{kind}: {answers}", 20)
            assert is_good(other)
            (note,) = (one.note for one in read_status(cell.attachment.instance).processes if one.name == f"{kind}-plc")
            assert answers in note
            cell.disturb(f"{kind}-plc", "ok")
            until(partial(is_good, kind), f"{kind}: good after {answers}", 20)
    with pytest.raises(ControlError):
        cell.disturb("plc", "hang")
