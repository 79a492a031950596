"""A whole instance that reads and writes a Modbus device."""

from __future__ import annotations

import json
from collections.abc import Callable

from shmio.testing.cell import Cell, until
from tests.unit.connectors.modbus.device import Device

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "pumps"
connector = "modbus"
layout = "pump.toml"
period_ms = 20
timeout = 500
host = "127.0.0.1"
port = PORT
[grpc]
listen = ["{grpc}"]
"""
TABLE = """
[registers]
"pump/Running" = { type = "BOOL", address = "discrete 0" }
"pump/Speed" = { type = "REAL", address = "holding 100 UINT", scale = 0.1, unit = "1/s", writable = true }
"pump/Gone" = { type = "INT", address = "holding 5000" }
"""


def test_a_device_is_read_written_lost_and_back(make_cell: Callable[..., Cell]) -> None:
    with Device() as device:
        device.set("discrete", 0, [1])
        device.set("holding", 100, [125])
        cell = make_cell(config=CONFIG.replace("PORT", str(device.address.port)))
        (cell.folder / "pump.toml").write_text(TABLE)
        cell.up()
        until(lambda: cell.processes()["pumps"]["quality"] == "good", "good quality")
        for host in ((), ("--host", str(cell.grpc))):
            found = json.loads(cell.output("shmio", "get", "--json", *host, "pump"))
            assert {path: (one["value"], one["quality"]) for path, one in found.items()} == {
                "pumps/pump/Running": (True, "good"),
                "pumps/pump/Speed": (12.5, "good"),
                "pumps/pump/Gone": (0, "bad"),
            }
            assert "BadOutOfRange" in found["pumps/pump/Gone"]["reason"]
        cell.output("shmio", "set", "pump/Speed", "99.9")
        assert device.get("holding", 100) == [999]
        assert "not writable" in cell.run("shmio", "set", "pump/Running", "false").stderr
    until(lambda: cell.processes()["pumps"]["quality"] == "bad", "bad quality")
    assert "pump/Speed" in cell.output("shmio", "get", "pump/Speed")
