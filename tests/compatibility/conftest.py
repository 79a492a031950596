"""The versions that are stored, and one live instance for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.testing.cell import Cell, until
from shmio.testing.ports import reserved_port
from tests.compatibility.store import LAYOUT

BASELINES = Path(__file__).parent / "baselines"
CONFIG = """
[instance]
name = "{instance}"

[[source]]
name = "sim"
connector = "simulation"
model = "shmio.simulation.loopback:Loopback"
period_ms = 20
stale_ms = 60_000
writable = ["joints/**", "safetyzones/**"]

[[source]]
name = "notes"
connector = "memory"
layout = "notes.db"
period_ms = 50
stale_ms = 60_000
writable = ["**"]

[[injection]]
name = "drift"
target = "notes/level"
operation = "offset"
value = 0.25
start_s = 0

[grpc]
listen = ["{grpc}"]
default_source = "sim"
"""


@pytest.fixture(params=sorted(folder.name for folder in BASELINES.iterdir()))
def baseline(request: pytest.FixtureRequest) -> Path:
    """Return the folder of a stored version."""
    name: str = request.param
    return BASELINES / name


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory, shared_instance: str) -> Iterator[Cell]:
    """Start an instance of this version, in wall time."""
    folder = tmp_path_factory.mktemp("live")
    (folder / "notes.db").write_text(LAYOUT)
    with reserved_port() as grpc:
        (folder / "supervisor.toml").write_text(CONFIG.format(instance=shared_instance, grpc=grpc))
        cell = Cell(folder, shared_instance, grpc)
        try:
            cell.up()
            until(lambda: cell.processes()["notes"]["quality"] == "good", "good quality")
            yield cell
        finally:
            cell.supervisor("down")
