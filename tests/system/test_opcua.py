"""A cell with an OPC UA endpoint, seen by node-opcua's client, which shares no code with ours."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import shmio
from shmio.config import Address
from shmio.testing.cell import CONFIG, Cell, kill, until
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.opcua.certificates import self_signed

NODE = Path(__file__).parents[1] / "unit/endpoints/node"
SOURCE = 'connector = "s7"\n'
PASSWORD = "a-long-and-random-password"
TIMEOUT_S = 60

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")


@pytest.fixture
def address() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


def started(make_cell: Callable[..., Cell], address: Address, more: str = "") -> Cell:
    writable = CONFIG.replace(SOURCE, f'{SOURCE}writable = ["Outputs"]\n')
    cell = make_cell(config=f'{writable}\n[opcua]\nlisten = "{address}"\n{more}')
    cell.up()
    return cell


def run(cell: Cell, address: Address, folder: Path, *user: str) -> dict[str, object]:
    command = ["node", str(NODE / "opcua.js"), f"opc.tcp://{address}", str(folder), cell.instance, *user]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stderr + cell.logs()
    found: dict[str, object] = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))
    return found


def check(cell: Cell, found: dict[str, object]) -> None:
    values = found["values"]
    assert isinstance(values, dict)
    assert len(values) == 22
    with shmio.connect(str(cell.grpc)) as remote:
        served: dict[str, Any] = {reading.path: reading.value for reading in remote.get(*values)}
    assert sorted(served) == sorted(values)
    for both in (values, served):
        del both["cell/Inputs"]  # it has a counter of the controller's cycles
        del both["cell/Outputs"][0]  # its heartbeat
    assert values == served
    assert found["status"] == "Good"
    assert found["path"] == "ns=2;s=cell/Robot_800"
    assert found["change"] == "seen"
    assert (found["part"], found["beyond"]) == ([2, 1, "Good", 7, 9], "BadIndexRangeNoData")
    assert (found["written"], found["refused"], found["unknown"]) == ("Good", "BadNotWritable", "BadNodeIdUnknown")


def test_an_independent_client_uses_the_cell(make_cell: Callable[..., Cell], address: Address, tmp_path: Path) -> None:
    cell = started(make_cell, address)
    process = cell.processes()["opcua"]
    assert (process["kind"], process["state"]) == ("opcua", "running")
    check(cell, run(cell, address, tmp_path / "pki"))
    kill(process["pid"])
    until(lambda: cell.processes()["opcua"]["restarts"] == 1, "the endpoint's restart")
    until(lambda: cell.processes()["opcua"]["state"] == "running", "the endpoint")
    check(cell, run(cell, address, tmp_path / "pki"))


def test_an_independent_client_with_an_encrypted_channel_and_an_account(
    make_cell: Callable[..., Cell], address: Address, tmp_path: Path
) -> None:
    certificate, key = self_signed(tmp_path, "urn:test:server")
    hashed = hashlib.sha256(PASSWORD.encode()).hexdigest()
    more = f'certificate = "{certificate}"\nkey = "{key}"\n\n[[opcua.account]]\nname = "operator"\n'
    cell = started(make_cell, address, f'{more}roles = ["read", "write"]\nsha256 = "{hashed}"\n')
    check(cell, run(cell, address, tmp_path / "pki", "operator", PASSWORD))
