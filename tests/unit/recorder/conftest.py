"""An instance without a supervisor. The tests publish for its sources."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.segment import EventKind, ProcessSpec, Record, Segment
from tests.unit.recorder.harness import publish, recorder, spec


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    """Create a segment of two sources with rings of 512 frames, and a process slot for the recorder."""
    processes = [ProcessSpec("cell", "source"), ProcessSpec("recorder", "recorder")]
    with Segment.create(instance, [spec("cell"), spec("press")], processes) as segment:
        yield segment
        segment.unlink()


@pytest.fixture
def recording(segment: Segment, tmp_path: Path) -> bytes:
    """Return the bytes of a recording with several chunks."""
    work = recorder(segment, tmp_path / "whole")
    writer = segment.writer("cell")
    for turn in range(4):
        publish(writer, 10, first=turn * 10)
        writer.event(Record(EventKind.QUALITY, "so so"))
        if turn == 1:
            publish(writer, 1200)
        work.run_once()
        work._writer.flush()
    assert work.close()
    return work.output.path.read_bytes()
