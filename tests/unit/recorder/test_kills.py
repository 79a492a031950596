"""The recorder is killed repeatedly at random moments, while a source publishes."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from pathlib import Path

import mcap.reader
import pytest

from shmio.recording.check import check
from shmio.recording.reading.reader import Reader
from shmio.segment import BlockSpec, ProcessSpec, Segment
from shmio.testing.cell import kill, until
from tests.unit.recorder.harness import LAYOUT, Process, gaps
from tests.unit.recorder.test_process import ready

KILLS = 20
PERIOD_S = 0.02
SEED = 20


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    """Create a segment with a ring sized for a far faster source, so that it keeps frames for minutes."""
    processes = [ProcessSpec("cell", "source"), ProcessSpec("recorder", "recorder")]
    with Segment.create(instance, [BlockSpec("cell", LAYOUT, 500_000, 10**9, 1 << 27)], processes) as segment:
        yield segment
        segment.unlink()


def frames(file: Path) -> list[int]:
    """Return the frame numbers that the mcap library reads through the index, with a check of every checksum."""
    with file.open("rb") as stream:
        messages = mcap.reader.make_reader(stream, validate_crcs=True).iter_messages(topics=["cell/frames"])
        return [message.sequence for _, _, message in messages]


@pytest.mark.timeout(600)
def test_a_kill_at_any_moment_loses_no_frame_and_leaves_intact_files(segment: Segment, tmp_path: Path) -> None:
    """The successor reads from the ring the frames that the killed recorder had not written."""
    writer, over, chance = segment.writer("cell"), threading.Event(), random.Random(SEED)

    def source() -> None:
        while not over.wait(PERIOD_S):
            head = writer.block.ring.head()
            writer.publish((head & 0x7FFF).to_bytes(2, "big"), cycle=head)

    thread = threading.Thread(target=source)
    thread.start()
    try:
        for _ in range(KILLS):
            with Process(segment, tmp_path) as process:
                until(lambda: ready(process), "its file", 60)
                over.wait(chance.choice([0.0, chance.uniform(0, 0.1), chance.uniform(0, 1.2)]))
                kill(process.popen.pid)
        with Process(segment, tmp_path) as process:
            until(lambda: ready(process), "its file", 60)
            folder = process.folder
            until(
                lambda: all(closed(file) for file in folder.iterdir() if file != process.file),
                "all earlier files closed",
            )
            over.set()
            thread.join()
            assert process.stop() == 0
    finally:
        over.set()
        thread.join()
    found: list[int] = []
    for file in folder.iterdir():
        if not file.stat().st_size:
            continue  # killed before its first byte
        found += frames(file)
        assert gaps(file) == []
        with Reader(file) as reader:
            assert check(reader).whole
    assert sorted(found) == list(range(1, writer.block.ring.head() + 1)), "each frame once"


def closed(file: Path) -> bool:
    if not file.stat().st_size:
        return True
    with Reader(file) as reader:
        return reader.records.footer() is not None
