"""A segment with one source. Only the test publishes its frames."""

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
