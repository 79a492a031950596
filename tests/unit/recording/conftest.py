"""An instance without a supervisor, whose sources the tests play."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from shmio.segment import ProcessSpec, Segment
from tests.unit.recording.harness import spec


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    """Two sources, with rings of 512 frames, and the recorder's place."""
    processes = [ProcessSpec("cell", "source"), ProcessSpec("recorder", "recorder")]
    with Segment.create(instance, [spec("cell"), spec("press")], processes) as segment:
        yield segment
        segment.unlink()
