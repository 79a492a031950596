"""The example for machine tools by OPC UA reads a server with the nodes of the specification."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from shmio.testing.cell import Cell, until
from shmio.testing.ports import reserved_port

EXAMPLE = Path(__file__).parents[2] / "examples" / "umati"
SERVER = Path(__file__).with_name("umati_server.py")


def test_check_accepts_the_example(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=(EXAMPLE / "supervisor.toml").read_text())
    shutil.copy(EXAMPLE / "tags.toml", cell.folder)
    assert "opc.tcp://127.0.0.1:4840" in cell.output("shmio-supervisor", "check")


def test_the_example_reads_a_machine(make_cell: Callable[..., Cell]) -> None:
    config = (EXAMPLE / "supervisor.toml").read_text()
    config = config.replace("umati-example", "{instance}").replace("127.0.0.1:8089", "{grpc}")
    with reserved_port() as address:
        command = [sys.executable, str(SERVER), str(address.port)]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as server:
            assert server.stdout is not None
            assert server.stdout.readline() == "ready\n"
            cell = make_cell(config=config.replace("127.0.0.1:4840", str(address)))
            shutil.copy(EXAMPLE / "tags.toml", cell.folder)
            cell.up()
            until(lambda: cell.processes()["cnc"]["quality"] == "good", "good quality")
            shown = json.loads(cell.output("shmio", "get", "--json", "cnc"))
            server.communicate(timeout=60)
    found = {path.removeprefix("cnc/"): one["value"] for path, one in shown.items() if one["quality"] == "good"}
    assert found == {
        "Identification/Manufacturer": "Maker",
        "Identification/SerialNumber": "4711",
        "Machine/OperationMode": 1,
        "Machine/FeedOverride": 95.5,
        "Machine/PowerOnDuration": 1234,
        "Channel1/Mode": 6,
        "Channel1/FeedOverride": 80.0,
        "Spindle1/Rotating": True,
        "Program/Name": "PART_7.MPF",
        "Program/State": "Running",
    }
    assert "BadNodeIdUnknown" in shown["cnc/Spindle1/Override"]["reason"]
