"""The check of recordings accepts what a recorder may write, and detects each kind of error."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from shmio.layout.model import Layout, Register
from shmio.model.values import NO_WRITER
from shmio.recorder.file_output import Output, create
from shmio.recorder.instance_follower import InstanceFollower
from shmio.recorder.recorder import Recorder
from shmio.recording.format.encoding import Gap, Reason
from shmio.segment import BlockSpec, Event, EventKind, Frame, Quality, Record, Segment
from tests.faults import recorded
from tests.faults.checks import Source
from tests.faults.recorded import BlockCheck, Watch
from tests.faults.test_checks import FIRST, MS, PERIOD_NS, SIZE, STALE_NS, STARTED_NS, TOLERANCE_NS, frame
from tests.faults.truth import image, places

RING_NS = 10 * PERIOD_NS
SOURCE = Source("cell", SIZE, PERIOD_NS, STALE_NS, TOLERANCE_NS, one_pdu=False)
Item = Frame | Event | Gap


@pytest.fixture
def found() -> list[str]:
    return []


@pytest.fixture
def check(found: list[str], monkeypatch: pytest.MonkeyPatch) -> BlockCheck:
    monkeypatch.setattr(recorded, "REMEMBERED_NS", 1 << 62)  # times of these tests begin at 0
    return BlockCheck(SOURCE, RING_NS, found.append)


def good(number: int, **changes: Any) -> Frame:
    return frame(number, **{"raw": image(FIRST + 2 * number, places(SIZE)), **changes})


def gap(first: int, last: int, what: str = "frames") -> Gap:
    return Gap("cell", 1, what, first, last, last - first + 1, Reason.NOT_RUNNING)


def event(number: int, frame: int) -> Event:
    return Event(
        number, EventKind.STARTED, frame, frame, 0, 0, 0, 1, Quality.GOOD, NO_WRITER, 0, 0, 1, 0, 0, 0, b"", ""
    )


def feed(check: BlockCheck, *items: Item, epoch: str = "1", away_ns: int = 0, section: int = 0) -> None:
    """Check one file."""
    check.begin(epoch, STARTED_NS, away_ns)
    for item in items:
        check.item(item, section)


def test_good_recordings_pass(check: BlockCheck, found: list[str]) -> None:
    feed(check, event(1, 0), good(1, event=1), gap(2, 3), good(4, event=1), event(2, 4))
    feed(check, gap(5, 9), good(10, event=2), away_ns=RING_NS + 6 * PERIOD_NS)  # the ring was overrun
    feed(check, good(11, event=2), good(12, event=2))
    feed(check, good(1), epoch="2")  # another run
    feed(check, good(1), epoch="2", section=5)  # a reload has replaced the block
    assert found == []
    assert (check.counts.frames, check.counts.missed) == (7, 7)


BAD: dict[str, tuple[list[list[Item]], str]] = {
    "a frame lost": ([[good(1), good(3)]], "comes after frame 1 with 0 missed"),
    "a frame lost between two files": ([[good(1)], [good(3)]], "comes after frame 1 with 0 missed"),
    "a frame twice": ([[good(1), good(2)], [good(2), good(3)]], "comes after frame 2 with 0 missed"),
    "a wrong gap": ([[good(1), gap(2, 2), good(4)]], "with 1 missed"),
    "more lost than the ring had": ([[good(1)], [gap(2, 4), good(5)]], "3 frames in 80 ms before frame 5 are lost"),
    "an event lost": ([[event(1, 0), event(3, 0)]], "event 3 comes after event 1 with 0 missed"),
    "an event too late": ([[good(1), good(2), event(1, 1)]], "comes after a later frame"),
    "an event too early": ([[event(1, 0), event(2, 1), good(1, event=1)]], "comes after a later event"),
    "bytes of nobody": ([[good(1, raw=bytes(range(SIZE)))]], "bytes that the PLC never had"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_recordings_are_found(name: str, check: BlockCheck, found: list[str]) -> None:
    files, problem = BAD[name]
    for items in files:
        feed(check, *items)
    assert problem in found[0]


def test_a_file_that_begins_with_a_gap(instance: str, tmp_path: Path, check: BlockCheck, found: list[str]) -> None:
    layout = Layout("DB1", 1, SIZE, False, (Register("raw", "BYTE", ((1, SIZE),), 0, None, SIZE, SIZE),))
    with Segment.create(instance, [BlockSpec("cell", layout, PERIOD_NS, STALE_NS, 1 << 16)], []) as segment:
        writer = segment.writer("cell")
        for item in range(3000):
            writer.event(Record(EventKind.WRITTEN, item=item))
        for number in range(1, 3000):
            writer.publish(image(FIRST + 2 * number, places(SIZE)), cycle=number)
        file, fd = create(tmp_path, instance)
        assert Recorder(InstanceFollower(segment), Output(file, fd, limit_bytes=1 << 26), by="test").close()
        segment.unlink()
    recorded.check(file, 1 << 62, {"cell": check})
    assert check.counts.missed > 0, found


def test_files_are_checked_in_their_order_and_removed(tmp_path: Path) -> None:
    checked: list[tuple[str, bool]] = []
    watch = Watch(tmp_path, lambda file, away_ns: checked.append((file.name, away_ns >= 1000 * MS)))
    for name in "zyxwv":  # the clock goes back
        file = tmp_path / f"{name}.mem"
        file.write_bytes(b"not empty")
        watch.look(ended=False, slack_ns=0)
        past_ns = file.stat().st_mtime_ns - 1000 * MS
        os.utime(file, ns=(past_ns, past_ns))
    assert [name for name, _ in checked] == ["z.mem", "y.mem", "x.mem", "w.mem"]
    watch.look(ended=True, slack_ns=0)
    assert checked[1:] == [(f"{name}.mem", True) for name in "yxwv"]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["v.mem", "w.mem", "x.mem"]
