"""A NATS server, and a segment with one source whose frames the test publishes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from tests.nats_server import NatsServer, nats_server
from tests.unit.endpoints.fabric.harness import LAYOUT


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    with nats_server(tmp_path / "nats") as server:
        yield server


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    cell = BlockSpec("cell", LAYOUT, 20_000_000, 60_000_000_000, 1 << 22, Attributes("test", ("count",)))
    mirror = BlockSpec("far", LAYOUT, 20_000_000, 60_000_000_000, 1 << 20, Attributes("fabric"))
    processes = [ProcessSpec("cell", "source"), ProcessSpec("far", "source"), ProcessSpec("fabric", "fabric")]
    with Segment.create(instance, [cell, mirror], processes) as segment:
        yield segment
        segment.unlink()
