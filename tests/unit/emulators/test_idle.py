"""An emulated controller without a program: its blocks are memory, with any layout."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import snap7
from snap7.type import Area, WordLen

from shmio.config.address import Address
from shmio.connectors.s7 import S7Client, S7Options
from shmio.emulators.emulator import Emulator
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout

LOOPBACK = Address("127.0.0.1", 0)
GOLDEN = Path(__file__).parents[2] / "golden/layout"
LAYOUTS = [GOLDEN / "db201-as-printed.db", *sorted((GOLDEN / "rules").iterdir())]
TWO = """
DATA_BLOCK DB7
STRUCT
  on : Bool := TRUE;
  off : Bool;
  speed : Real := 12.5;
  name : String[8] := 'first';
END_STRUCT;
BEGIN
END_DATA_BLOCK
DATA_BLOCK DB9
STRUCT
  counts : Array[1..3] of Int := [1, 2, 3];
END_STRUCT;
BEGIN
  counts[2] := 20;
END_DATA_BLOCK
"""


def compiled(*sources: Source) -> tuple[Layout, ...]:
    return compile_sources(sources).layouts


def read(emulator: Emulator, number: int, size: int) -> bytes:
    """Read the whole block over a new connection."""
    options = S7Options(host=emulator.address.host, port=emulator.address.port)
    with closing(S7Client(options, number, size)) as client:
        client.connect()
        return bytes(client.read())


@contextmanager
def other_client(emulator: Emulator) -> Iterator[snap7.Client]:
    client = snap7.Client()
    client.connect(emulator.address.host, 0, 1, emulator.address.port)
    yield client
    client.disconnect()
    client.destroy()


@pytest.mark.parametrize("file", LAYOUTS, ids=lambda file: file.name)
def test_serves_the_initial_values_of_every_layout(file: Path) -> None:
    for layout in compiled(Source(file.name, file.read_bytes())):
        with Emulator(layout, "idle", LOOPBACK, db_number=5) as emulator:
            assert read(emulator, 5, layout.size) == bytes(initial_frame(layout)[0])


def test_written_values_survive_disconnection_stop_and_start() -> None:
    first, second = compiled(Source("two.db", TWO.encode()))
    wanted, counts = bytes.fromhex("0100 41480000 0805") + b"first\0\0\0", bytearray.fromhex("0001 0014 0003")
    with Emulator(first, "idle", LOOPBACK, others=[second]) as emulator:
        assert read(emulator, 7, first.size) == wanted
        assert read(emulator, 9, second.size) == counts
        with other_client(emulator) as client:
            client.write_area(Area.DB, 7, 1, bytearray(b"\1"), WordLen.Bit)
            client.db_write(7, 6, bytearray(b"\x08\x03new"))
        wanted = bytes.fromhex("0300 41480000 0803") + b"newst\0\0\0"
        for value, order in enumerate(("plc_stop", "plc_cold_start", "plc_stop", "plc_hot_start"), 1):
            with other_client(emulator) as client:
                getattr(client, order)()
                client.db_write(9, 4, bytearray((0, value)))
            counts[5] = value
            assert read(emulator, 7, first.size) == wanted
            assert read(emulator, 9, second.size) == counts
    with Emulator(first, "idle", LOOPBACK) as emulator:
        assert read(emulator, 7, first.size) == bytes(initial_frame(first)[0])
