"""A segment with one source. Only the test publishes its frames."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import pytest
from asyncua.server.internal_server import InternalServer

from shmio.endpoints.opcua.nodes import OBJECTS
from shmio.segment import Segment
from tests.unit.endpoints.opcua.harness import processes, spec


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with Segment.create(instance, [spec()], processes()) as segment:
        yield segment
        segment.unlink()


_standard: dict[Any, Any] = {}


@pytest.fixture(autouse=True)
def standard_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Create the standard's 6,000 nodes once for all servers.

    Servers change only the references of the folder Objects, which this fixture restores.
    """
    original = InternalServer.load_standard_address_space

    async def load(server: InternalServer, shelf_file: None = None) -> None:
        if not _standard:
            await original(server, shelf_file)
            _standard.update(server.aspace._nodes)
        server.aspace._nodes = dict(_standard)
        objects = _standard[OBJECTS]
        objects.references = [one for one in objects.references if one.NodeId.NamespaceIndex == 0]

    monkeypatch.setattr(InternalServer, "load_standard_address_space", load)


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    library = logging.getLogger("asyncua")
    before, library.level = library.level, logging.CRITICAL
    yield
    library.level = before
