"""A segment with one source, not published by anybody but the test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, WRITABLE


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
    with Segment.create(instance, [block], [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()
