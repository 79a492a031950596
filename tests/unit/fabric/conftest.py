"""A NATS server with the history of a cell, and the cell's segment."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.nats_server import nats_server
from tests.unit.fabric.stored import History
from tests.unit.recorder.conftest import segment

__all__ = ["segment"]


@pytest.fixture
def history(tmp_path: Path) -> Iterator[History]:
    with nats_server(tmp_path / "nats") as server:
        yield History(server.url)
