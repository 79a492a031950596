"""A whole instance that reads a tag table from a controller, which is lost and comes back."""

from __future__ import annotations

import json
from collections.abc import Callable

from snap7.type import SrvArea

from shmio.config import Address
from shmio.emulators.s7 import S7Server
from shmio.testing.cell import Cell, until

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "press"
connector = "s7"
layout = "press.toml"
period_ms = 20
host = "127.0.0.1"
port = PORT
timeout = 1000
connection = "op"
"""
TABLE = """
[registers]
"Door/Closed" = { type = "BOOL", address = "%I0.3" }
"Speed" = { type = "REAL", address = "DB5.DBD4", unit = "mm/s", writable = true }
"Lamp" = { type = "BOOL", address = "%Q1.2", writable = true }
"Gone" = { type = "INT", address = "DB6.DBW0" }
"""


def serve(port: int, block: bytearray, outputs: bytearray) -> S7Server:
    server = S7Server(Address("127.0.0.1", port))
    server.add_block(5, block)
    server.add_area(SrvArea.PE, bytearray(b"\x08\0"))
    server.add_area(SrvArea.PA, outputs)
    server.start()
    return server


def test_a_table_is_read_written_lost_and_back(make_cell: Callable[..., Cell]) -> None:
    block, outputs = bytearray(8), bytearray(b"\xff\xf0")
    server = serve(0, block, outputs)
    port = server.address.port
    try:
        cell = make_cell(config=CONFIG.replace("PORT", str(port)))
        (cell.folder / "press.toml").write_text(TABLE)
        assert f"127.0.0.1:{port}" in cell.output("shmio-supervisor", "check")
        cell.up()
        until(lambda: cell.processes()["press"]["quality"] == "good", "good quality")
        found = json.loads(cell.output("shmio", "get", "--json", "Door", "Speed", "Gone"))
        assert {path: (one["value"], one["quality"]) for path, one in found.items()} == {
            "press/Door/Closed": (True, "good"),
            "press/Speed": (0.0, "good"),
            "press/Gone": (0, "bad"),
        }
        assert "BadNodeIdUnknown" in found["press/Gone"]["reason"]
        cell.output("shmio", "set", "Speed", "1.5")
        cell.output("shmio", "set", "Lamp", "true")
        assert block[4:] == b"\x3f\xc0\0\0"
        assert outputs == b"\xff\xf4"
        server.stop()
        until(lambda: cell.processes()["press"]["quality"] == "bad", "bad quality")
        server = serve(port, block, outputs)
        until(lambda: cell.processes()["press"]["quality"] == "good", "good quality")
        assert cell.processes()["press"]["restarts"] == 0
    finally:
        server.stop()
