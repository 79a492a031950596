"""A segment with one source. Only the test publishes its frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from tests.unit.endpoints.harness import LAYOUT, SOON_STALE_NS, STALE_NS, TIMEOUT_S, WRITABLE


@contextmanager
def _segment(instance: str, stale_ns: int) -> Iterator[Segment]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, stale_ns, 1 << 20, Attributes("test", WRITABLE))
    processes = [ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]
    with Segment.create(instance, [block], processes) as segment:
        yield segment
        segment.unlink()


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with _segment(instance, STALE_NS) as segment:
        yield segment


@pytest.fixture
def soon_stale(instance: str) -> Iterator[Segment]:
    """Create a segment for tests about age: its frames soon become stale."""
    with _segment(instance, SOON_STALE_NS) as segment:
        yield segment


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prevent commands from expiring because the host is busy."""
    monkeypatch.setattr("shmio.local.writer.WRITE_TIMEOUT_S", TIMEOUT_S)
