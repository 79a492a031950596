"""Emulated controllers with the memory that tag tables need."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
import snap7
from snap7.type import Area

from shmio.config import Address
from shmio.emulators.areas import TableMemory, place_name
from shmio.emulators.emulator import Emulator
from shmio.errors import ConfigError
from shmio.layout import compiler
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import Value, codec
from shmio.testing.cell import until

TAGS: dict[str, object] = {
    "bit": {"type": "BOOL", "address": "DB1.DBX0.1", "initial": True},
    "int": {"type": "INT", "address": "DB1.DBW4", "initial": -2},
    "text": {"type": "STRING[6]", "address": "DB1.DBB10", "initial": "abc"},
    "empty": {"type": "STRING[6]", "address": "DB1.DBB20"},
    "time": {"type": "DTL", "address": "DB2.DBB20"},
    "list": {"type": "ARRAY[0..2] OF REAL", "address": "DB2.DBD40", "initial": [1.0, -2.5]},
    "flags": {"type": "ARRAY[0..9] OF BOOL", "address": "DB2.DBB52", "initial": [True, False, True]},
    "input": {"type": "BOOL", "address": "E0.7", "initial": True},
    "word": {"type": "WORD", "address": "%IW256:P", "initial": 0x1234},
    "output": {"type": "BYTE", "address": "%QB4", "initial": 7},
    "marker": {"type": "BOOL", "address": "%M3.7", "initial": True},
    "scaled": {"type": "REAL", "address": "%MW2000 INT", "scale": [0.5, 10.0], "initial": 60.0},
    "cold": {"type": "REAL", "address": "%MB2002 USINT", "scale": [0.5, 10.0]},
    "timer": {"type": "S5TIME", "address": "T5", "initial": "S5T#2m3s"},
    "delay": {"type": "TIME", "address": "T6", "initial": "T#1s500ms"},
    "counter": {"type": "INT", "address": "Z3", "initial": 123},
    "bits": {"type": "WORD", "address": "Z4", "initial": 0x0ABC},
    "state": {"type": "STRING[9]", "address": "cpu.state"},
}
NEEDS = {"DB1": 28, "DB2": 54, "%I": 1024, "%Q": 1024, "%M": 2004, "%T": 512, "%C": 512}


def table(tags: dict[str, object], name: str = "table") -> Layout:
    return place_tags(name, tags)


@contextlib.contextmanager
def client(emulator: Emulator) -> Iterator[snap7.Client]:
    found = snap7.Client()
    with emulator:
        found.connect("127.0.0.1", 0, 1, emulator.address.port)
        try:
            yield found
        finally:
            found.disconnect()


def emulator(*layouts: Layout, program: str = "idle") -> Emulator:
    return Emulator(layouts[0], program, Address("127.0.0.1", 0), others=layouts[1:])


def test_areas_that_a_table_needs() -> None:
    assert {place_name(place): size for place, size in TableMemory(table(TAGS)).needs.items()} == NEEDS


def test_python_snap7_reads_the_initial_values() -> None:
    with client(emulator(table(TAGS))) as plc:
        one, two = plc.db_read(1, 0, 28), plc.db_read(2, 0, 54)
        with pytest.raises(snap7.error.S7Error):
            plc.db_read(1, 0, 29)
        inputs, outputs = bytes(plc.eb_read(0, 258)), plc.ab_read(0, 5)
        markers = bytes(plc.mb_read(3, 1)), bytes(plc.mb_read(2000, 3))
        timers = plc.read_area(Area.TM, 0, 5, 2)
        counters = plc.read_area(Area.CT, 0, 3, 2)
    assert one == b"\2\0\0\0\xff\xfe\0\0\0\0\6\3abc\0\0\0\0\0\6\0\0\0\0\0\0\0"
    assert two[20:32] == bytes.fromhex("07b20101050000000000000000"[:24])
    assert two[40:] == bytes.fromhex("3f800000 c0200000 00000000 0500")
    assert (inputs[0], inputs[256:], outputs[4]) == (0x80, b"\x12\x34", 7)
    assert markers == (b"\x80", b"\0\x64\0"), "what cannot be 0 begins with bytes of 0"
    assert bytes(timers) == b"\x21\x23\x01\x50"
    assert bytes(counters) == b"\x01\x23\x0a\xbc"


def test_what_is_written_stays() -> None:
    with client(emulator(table(TAGS))) as plc:
        plc.eb_write(0, 1, bytearray(b"\x01"))
        plc.db_write(2, 40, bytearray(b"\x40\0\0\0"))
        assert bytes(plc.eb_read(0, 1) + plc.db_read(2, 40, 4)) == b"\x01\x40\0\0\0"


def test_tables_and_blocks_share_a_controller() -> None:
    """The block keeps its values, but for those that the table gives."""
    source = """DATA_BLOCK DB1
    STRUCT a : Int := 7; b : Int := 8; END_STRUCT; BEGIN END_DATA_BLOCK"""
    (block,) = compiler.Program([compiler.Source("x.db", source.encode())]).compile(None).layouts
    first = table({"b": {"type": "INT", "address": "DB1.DBW2", "initial": 9}, "m": {"type": "INT", "address": "%MW0"}})
    second = table({"a": {"type": "INT", "address": "DB1.DBW0"}, "n": {"type": "INT", "address": "DB3.DBW4"}})
    for layouts in ((block, first, second), (first, block, second)):
        with client(emulator(*layouts)) as plc:
            assert plc.db_read(1, 0, 4) == b"\0\7\0\x09"
            assert len(plc.db_read(3, 0, 6)) == 6
    with pytest.raises(ConfigError, match="needs 6 bytes of DB1, whose layout has 4"):
        emulator(block, table({"c": {"type": "INT", "address": "DB1.DBW4"}}))


def test_a_program_runs_on_a_table() -> None:
    tags: dict[str, object] = {
        "speed": {"type": "REAL", "address": "%MW10 INT", "scale": 0.1},
        "on": {"type": "BOOL", "address": "%Q0.3"},
        "all": {"type": "ARRAY[1..3] OF INT", "address": "DB1.DBW0"},
        "text": {"type": "STRING[4]", "address": "DB1.DBB6", "initial": "abc"},
        "set": {"type": "INT", "address": "DB1.DBW12", "writable": True, "initial": 5},
    }
    with client(emulator(table(tags), program="wave")) as plc:
        begun = bytes(plc.mb_read(10, 2))
        until(lambda: bytes(plc.mb_read(10, 2)) != begun, "a number that moves")
        assert 0 <= int.from_bytes(plc.mb_read(10, 2), "big") <= 1000
        numbers = plc.db_read(1, 0, 6)
        assert numbers[0:2] == numbers[2:4] == numbers[4:6]
        assert plc.db_read(1, 6, 6) == b"\4\3abc\0"
        plc.db_write(1, 12, bytearray(b"\0\6"))
        again = bytes(plc.mb_read(10, 2))
        until(lambda: bytes(plc.mb_read(10, 2)) != again, "another cycle")
        assert plc.db_read(1, 12, 2) == b"\0\6"


def test_values_that_are_no_values_do_not_stop_a_program() -> None:
    """The counter's bytes are no valid text, time or small number; the controller's are no BCD."""
    memory = TableMemory(table(TAGS))
    areas = {place: bytearray(size) for place, size in memory.needs.items()}
    memory.fill(areas)
    frame, _ = initial_frame(memory.layout)
    for value in (0, 0x55, 0xFF):
        before, frame[:] = bytes(frame), bytes((value,)) * len(frame)
        memory.store(before, frame, areas)
        memory.load(frame, areas)
    for area in areas.values():
        area[:] = b"\xff" * len(area)
    memory.load(frame, areas)


def test_load_and_store_are_inverse() -> None:
    memory = TableMemory(table(TAGS))
    areas = {place: bytearray(size) for place, size in memory.needs.items()}
    memory.fill(areas)
    frame = bytearray(memory.layout.size)
    memory.load(frame, areas)
    found: dict[str, Value] = {
        one.path: codec(one, memory.layout.byte_order).decode(frame) for one in memory.layout.registers
    }
    wanted = {"bit": True, "int": -2, "text": "abc", "list": [1.0, -2.5, 0.0], "scaled": 60.0, "cold": 10.0}
    assert {name: found[name] for name in wanted} == wanted
    assert (found["timer"], found["delay"], found["counter"], found["bits"]) == (123_000, 1500, 123, 0x0ABC)
    assert found["flags"] == [True, False, True] + [False] * 7


def test_a_wrong_address_is_a_fault_of_the_configuration() -> None:
    with pytest.raises(ConfigError, match=r"layout: x: address: 'DB0\.DBW0'"):
        TableMemory(table({"x": {"type": "INT", "address": "DB0.DBW0"}}))


def test_wave_moves_what_commands_cannot_write() -> None:
    with pytest.raises(ConfigError, match=r"program wave: .* no number or BOOL"):
        emulator(table({"x": {"type": "INT", "address": "%MW0", "writable": True}}), program="wave")
