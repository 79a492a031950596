"""Emulators that run a class of the user, or have faults on command."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.errors import ConfigError
from shmio.plan.prepare import Prepared, prepare

EMULATOR = """
[[emulator]]
name = "plc"
kind = "s7"
listen = "127.0.0.1:1102"
"""
PRESS = '[registers]\n"Speed" = { type = "INT", address = "DB5.DBW4", writable = true }\n'
PROGRAM = """
from shmio.plc import Input, Parameter, Program
class Door(Program):
    speed = Input("INT", path="Speed")
    most = Parameter("INT", 5)
    def scan(self, time_s, dt_s):
        pass
class Gate(Program):
    position = Input("INT", path="Position")
    def scan(self, time_s, dt_s):
        pass
"""


def prepared(folder: Path, *parts: str) -> Prepared:
    file = folder / "supervisor.toml"
    file.write_text('[instance]\nname = "emulated"\n' + "".join(parts))
    return prepare(file)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('program = "interlock:Gate"', "layout: .*Position"),
        ('program = "interlock:Roof"', "program: unknown class 'Roof' of interlock; valid: Door"),
        ('program = "gone:Door"', "program: .*gone"),
        ('program = "interlock:Door"\nparameters = { least = 1 }', "parameters.least"),
        ('program = "idle"\nparameters = { most = 1 }', "parameters: program idle has no parameters"),
        ('kind = "opcua"\nfaults = true', "faults: only emulators of kind s7 or modbus"),
        ('clock = "stepped"', "clock"),
    ],
)
def test_a_program_or_fault_that_is_not_possible_is_refused(tmp_path: Path, keys: str, message: str) -> None:
    (tmp_path / "interlock.py").write_text(PROGRAM)
    (tmp_path / "press.toml").write_text(PRESS)
    emulator = EMULATOR.replace('kind = "s7"\n', "") if "kind" in keys else EMULATOR
    nodes = '[registers]\n"Speed" = { type = "INT", address = "ns=2;s=Speed" }\n'
    (tmp_path / "nodes.toml").write_text(nodes)
    layout = "nodes.toml" if "kind" in keys else "press.toml"
    with pytest.raises(ConfigError, match=rf"emulator\[0\]\.{message}"):
        prepared(tmp_path, emulator, f'layout = "{layout}"\n{keys}\n')


def test_a_program_of_the_user_and_its_parameters_reach_the_emulator(tmp_path: Path) -> None:
    (tmp_path / "interlock.py").write_text(PROGRAM)
    (tmp_path / "press.toml").write_text(PRESS)
    keys = 'layout = "press.toml"\nprogram = "interlock:Door"\nparameters = { most = 7 }\n'
    (job,) = prepared(tmp_path, EMULATOR, keys).plan.jobs
    assert job.config["parameters"] == {"most": 7}
    assert job.config["folder"] == str(tmp_path)
