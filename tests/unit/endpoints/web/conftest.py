"""A segment with one source, which only the test publishes."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from shmio.endpoints.web import metrics
from shmio.segment import Segment
from tests.unit.endpoints.web.harness import processes, spec


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    with Segment.create(instance, [spec()], processes()) as segment:
        yield segment
        segment.unlink()


@pytest.fixture(autouse=True)
def always_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "FRESH_S", -1.0)
