"""The A50 cell from an independent OPC UA server, through shmio, to an independent OPC UA client."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import shmio
from shmio.testing.cell import Cell, until
from shmio.testing.ports import reserved_port
from tests.unit.connectors.opcua.node_server import NODE, NodeServer
from tests.unit.connectors.opcua.test_siemens import a50_nodes

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "cell"
connector = "opcua"
layout = "db201.db"
nodes = "siemens"
period_ms = 50
url = "SERVER"
writable = ["Outputs"]
[opcua]
listen = "ENDPOINT"
[grpc]
listen = ["{grpc}"]
"""
TIMEOUT_S = 60


def test_a_cell_passes_through_between_independent_programs(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    cell_nodes = a50_nodes()
    nodes = [{"id": node, "type": kind, "value": value, "writable": True} for node, kind, value in cell_nodes.values()]
    folder = tmp_path / "server"
    folder.mkdir()
    with NodeServer(folder, nodes) as server, reserved_port() as endpoint:
        cell = make_cell(config=CONFIG.replace("SERVER", server.url).replace("ENDPOINT", str(endpoint)))
        cell.up()
        until(lambda: cell.processes()["cell"]["quality"] == "good", "good quality")
        command = ["node", str(NODE / "opcua.js"), f"opc.tcp://{endpoint}", str(tmp_path / "pki"), cell.instance]
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        assert done.returncode == 0, done.stderr + cell.logs()
        found = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))
        with shmio.connect(str(cell.grpc)) as remote:
            served: dict[str, Any] = {reading.path: reading.value for reading in remote.get(*found["values"])}
        expected: dict[str, Any] = {f"cell/{path}": value for path, (_, _, value) in cell_nodes.items()}
        expected["cell/Outputs"][13] = 1  # the client has written it, by a node of the element alone
        assert len(expected) == 22
        assert found["values"] == served == expected
        assert (found["written"], found["change"], found["status"]) == ("Good", "seen", "Good")
        assert found["types"]["cell/Robot_800/Axs1_Pos"] == "Float"
