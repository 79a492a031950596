"""How far the processes of an instance are behind with reading frames."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

import pytest

from shmio.layout.model import Layout, Register
from shmio.segment import BlockSpec, BlockWriter, ProcessSpec, Report, Segment, Stamp
from shmio.segment.reader_lag import SILENT_NS, ReportedPosition

LAYOUT = Layout("DB1", 1, 4, False, (Register("speed", "REAL", (), 0, None, 4, 1),))
SECOND_NS = 1_000_000_000


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    spec = BlockSpec("cell", LAYOUT, 20_000_000, 3600 * SECOND_NS, 1 << 20)
    processes = [ProcessSpec("cell", "source"), ProcessSpec("recorder", "recorder"), ProcessSpec("mqtt", "mqtt")]
    with Segment.create(instance, [spec], processes) as created:
        for slot in created.processes:
            slot.report = Report(os.getpid())
        yield created
        created.unlink()


def publish(writer: BlockWriter, *ages_s: float) -> None:
    """Publish frames that are this old."""
    for age_s in ages_s:
        now_ns = time.monotonic_ns()
        writer.publish(bytes(4), cycle=1, at=Stamp(now_ns - round(age_s * SECOND_NS), now_ns))


def test_a_reader_is_as_late_as_its_oldest_unread_frame(segment: Segment) -> None:
    block, recorder, mqtt = segment.blocks["cell"], segment.processes.find("recorder"), segment.processes.find("mqtt")
    publish(segment.writer("cell"), 9, 5, 1)
    assert block.reader_lag(recorder) is None
    block.report_reader(recorder, 1)
    lag = block.reader_lag(recorder)
    assert lag is not None
    assert lag.frames == 2
    assert 5 <= lag.behind_ns / SECOND_NS < 6
    assert block.reader_lag(mqtt) is None, "each process has an entry of its own"
    block.report_reader(recorder, 3)
    assert block.reader_lag(recorder) == (0, 0)
    block.report_reader(recorder, None)
    assert block.reader_lag(recorder) is None


def test_if_the_unread_frame_is_overwritten_the_oldest_one_counts(segment: Segment) -> None:
    block, recorder = segment.blocks["cell"], segment.processes.find("recorder")
    count = 2 * block.ring.slot_count
    publish(segment.writer("cell"), *[7.0] * count)
    block.report_reader(recorder, 3)
    lag = block.reader_lag(recorder)
    assert lag is not None
    assert lag.frames == count - 3
    assert 7 <= lag.behind_ns / SECOND_NS < 8


def test_the_lag_of_a_hung_process_grows(segment: Segment) -> None:
    block, recorder = segment.blocks["cell"], segment.processes.find("recorder")
    publish(segment.writer("cell"), 1, 1, 1)
    silent_ns = time.monotonic_ns() - 2 * SILENT_NS
    block._readers.write(recorder.index, ReportedPosition(os.getpid(), 0, 1, 0, silent_ns))
    lag = block.reader_lag(recorder)
    assert lag is not None
    assert lag.frames == 2
    assert lag.behind_ns >= 2 * SILENT_NS
    block._readers.write(recorder.index, ReportedPosition(os.getpid(), 0, 3, 0, silent_ns))
    assert block.reader_lag(recorder) == (0, 0), "the source has published nothing since"


def test_an_entry_of_an_earlier_process_does_not_count(segment: Segment) -> None:
    block, recorder = segment.blocks["cell"], segment.processes.find("recorder")
    block.report_reader(recorder, 0)
    assert block.reader_lag(recorder) is not None
    recorder.report = Report(os.getpid() + 1)
    assert block.reader_lag(recorder) is None
