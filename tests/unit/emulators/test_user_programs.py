"""Programs that are classes of the user, on an emulated controller."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import snap7

from shmio.config.address import Address
from shmio.emulators.emulator import Emulator
from shmio.emulators.programs import UserCode, UserProgram
from shmio.errors import ConfigError, ModelError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.testing.cell import until

DOOR = """
DATA_BLOCK "DB7" STRUCT
   Inputs : Struct
      Closed : Bool;
   End_Struct;
   Outputs : Struct
      Locked : Bool;
      Scans : Int;
      Spare : Int;
   End_Struct;
END_STRUCT; BEGIN END_DATA_BLOCK
"""
PROGRAM = """
from shmio.plc import Input, Output, Parameter, Program, TON
class Door(Program):
    period_ms = 5
    wanted = Parameter("INT", 1)
    closed = Input("BOOL", path="Inputs/Closed")
    locked = Output("BOOL", path="Outputs/Locked")
    scans = Output("INT", path="Outputs/Scans")
    settled = TON(0.02)
    def start(self):
        self.scans = 100
    def scan(self, time_s, dt_s):
        self.locked = self.settled(self.closed)
        self.scans += self.wanted
class Broken(Program):
    scans = Output("INT", path="Outputs/Scans")
    def scan(self, time_s, dt_s):
        self.scans = 1 // 0
class Other(Program):
    missing = Input("BOOL", path="Inputs/Open")
    def scan(self, time_s, dt_s):
        pass
"""


class Client(snap7.Client):
    def close(self) -> None:
        self.disconnect()
        self.destroy()


@pytest.fixture
def code(tmp_path: Path) -> Iterator[UserCode]:
    modules, path = set(sys.modules), list(sys.path)
    (tmp_path / "interlock_of_test.py").write_text(PROGRAM)
    yield UserCode(str(tmp_path))
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


@pytest.fixture
def door() -> Layout:
    (layout,) = compile_sources([Source("door.db", DOOR.encode())]).layouts
    return layout


def test_a_program_reads_what_clients_write_and_keeps_what_it_does_not_declare(code: UserCode, door: Layout) -> None:
    with (
        Emulator(door, "interlock_of_test:Door", Address("127.0.0.1", 0), db_number=7, code=code) as emulator,
        closing(Client()) as plc,
    ):
        plc.connect(emulator.address.host, 0, 1, emulator.address.port)
        assert plc.db_read(7, 2, 1)[0] & 1 == 0
        plc.db_write(7, 6, bytearray(b"\x12\x34"))
        plc.db_write(7, 0, bytearray(b"\x01"))
        until(lambda: plc.db_read(7, 2, 1)[0] & 1 == 1, "the door is locked")
        plc.db_write(7, 4, bytearray(b"\x40\x00"))  # an output, which the program counts on from there
        until(lambda: int.from_bytes(plc.db_read(7, 4, 2), "big") > 0x4002, "scans")
        assert bytes(plc.db_read(7, 6, 2)) == b"\x12\x34"
    assert emulator.cycle.failure is None


def test_parameters_and_the_first_scan(code: UserCode, door: Layout) -> None:
    program = UserProgram("interlock_of_test:Door", door, UserCode(code.folder, {"wanted": 5}))
    frame = bytearray(door.size)
    program.step(0.0, frame)
    program.step(0.005, frame)
    assert int.from_bytes(frame[4:6], "big") == 110


def test_an_error_names_the_line_and_leaves_the_block_alone(code: UserCode, door: Layout) -> None:
    program = UserProgram("interlock_of_test:Broken", door, code)
    frame = bytearray(range(door.size))
    with pytest.raises(ModelError, match=r"ZeroDivisionError.*interlock_of_test\.py, line 18"):
        program.step(0.0, frame)
    assert frame == bytes(range(door.size))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("interlock_of_test:Door2", r"unknown class 'Door2'.*Door"),
        ("no_such_module_here:Door", "no module no_such_module_here"),
        ("interlock_of_test:Other", "Inputs/Open"),
        ("interlock", "unknown program 'interlock'.*package.module:Class"),
    ],
)
def test_a_program_that_does_not_fit_is_refused(code: UserCode, door: Layout, name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Emulator(door, name, Address("127.0.0.1", 0), db_number=7, code=code)
