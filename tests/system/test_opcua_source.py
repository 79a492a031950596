"""A whole instance that reads and writes an OPC UA server, which dies and comes back."""

from __future__ import annotations

import json
from collections.abc import Callable

from shmio.testing.cell import Cell, until
from tests.unit.connectors.opcua.device import Device

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "line"
connector = "opcua"
layout = "press.toml"
period_ms = 20
url = "URL"
timeout = 1000
publishing_ms = 20
sampling_ms = 20
[grpc]
listen = ["{grpc}"]
"""
TABLE = """
[registers]
"press/Open" = { type = "BOOL", address = "ns=2;s=open" }
"press/Speed" = { type = "REAL", address = "/Objects/2:Device/2:speed", unit = "mm/s", writable = true }
"press/Gone" = { type = "INT", address = "ns=2;s=gone" }
"""
OPTIMIZED = """
DATA_BLOCK "Data"
{ S7_Optimized_Access := 'TRUE' }
VERSION : 0.1
   STRUCT
      Speed : Real;
   END_STRUCT;
BEGIN
END_DATA_BLOCK
"""


def test_a_server_is_read_written_lost_and_back(make_cell: Callable[..., Cell]) -> None:
    with Device() as device:
        device.ask("add", "open", "Boolean", True, False)
        device.ask("add", "speed", "Float", 12.5)
        cell = make_cell(config=CONFIG.replace("URL", device.url))
        (cell.folder / "press.toml").write_text(TABLE)
        assert device.url in cell.output("shmio-supervisor", "check")
        cell.up()
        until(lambda: cell.processes()["line"]["quality"] == "good", "good quality")
        for host in ((), ("--host", str(cell.grpc))):
            found = json.loads(cell.output("shmio", "get", "--json", *host, "press"))
            assert {path: (one["value"], one["quality"]) for path, one in found.items()} == {
                "line/press/Open": (True, "good"),
                "line/press/Speed": (12.5, "good"),
                "line/press/Gone": (0, "bad"),
            }
            assert "BadNodeIdUnknown" in found["line/press/Gone"]["reason"]
        cell.output("shmio", "set", "press/Speed", "99.5")
        assert device.ask("get", "speed") == 99.5
        device.kill()
        until(lambda: cell.processes()["line"]["quality"] == "bad", "bad quality")
        device.restart()
        device.ask("add", "speed", "Float", 7.5)
        until(lambda: cell.processes()["line"]["quality"] == "good", "good quality")
        found = json.loads(cell.output("shmio", "get", "--json", "press/Speed"))
        assert found["line/press/Speed"]["value"] == 7.5
        assert cell.processes()["line"]["restarts"] == 0


def test_an_optimized_block_is_for_opc_ua(make_cell: Callable[..., Cell]) -> None:
    """An optimized block causes a warning for a source of S7, but not for one that reads it by names.

    The paths of the registers are those of the file.
    """
    config = CONFIG.replace("URL", "opc.tcp://127.0.0.1:4840").replace("press.toml", "data.db")
    cell = make_cell(config=config)
    (cell.folder / "data.db").write_text(OPTIMIZED)
    assert 'nodes = "siemens"' in cell.run("shmio-supervisor", "check").stderr
    cell = make_cell(config=config.replace("timeout", 'nodes = "siemens"\ntimeout'))
    (cell.folder / "data.db").write_text(OPTIMIZED)
    done = cell.run("shmio-supervisor", "check")
    assert (done.returncode, "ptimized" in done.stdout + done.stderr) == (0, False)
    keys = 'nodes = "siemens"\nsecurity = "Sign"\ncertificate = "mine.der"\nkey = "mine.key"\ntrusted = "t"\ntimeout'
    cell = make_cell(config=config.replace("timeout", keys))
    (cell.folder / "data.db").write_text(OPTIMIZED)
    assert f"certificate: {cell.folder / 'mine.der'}: No such file" in cell.run("shmio-supervisor", "check").stderr
