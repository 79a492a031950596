"""Recordings of what happens around a trigger."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from shmio.cli.dump import main
from shmio.config import Recorder as Settings
from shmio.config import Trigger as TriggerSettings
from shmio.errors import ConfigError
from shmio.recorder import file_output as output_module
from shmio.recorder.instance_follower import FROM_THE_FIRST, InstanceFollower, StartPositions
from shmio.recorder.recorder import no_attachments
from shmio.recorder.triggered import TriggeredRecorder
from shmio.recording.check import check
from shmio.recording.reading.reader import Reader
from shmio.recording.selection import Selection
from shmio.segment import BlockWriter, Event, EventKind, Origin, Quality, Record, Segment, Stamp
from shmio.testing.cell import kill, until
from tests.unit.recorder.harness import OTHER, RING, Process, gaps, numbers, publish, spec
from tests.unit.recorder.test_recorder_rotation import files

S = 1_000_000_000


class Bench:
    """A triggered recording of the cell, whose frames come a second apart: the tenth holds a 10, and so on."""

    def __init__(
        self,
        segment: Segment,
        folder: Path,
        start: StartPositions = FROM_THE_FIRST,
        *,
        begin_s: int = 100_000,
        selection: Selection | None = None,
        buffer_mb: float = 16,
        **trigger: object,
    ) -> None:
        """``begin_s``: when the frames are, on the host's clock since the instance's start."""
        self.folder = folder
        self._begin_ns = segment.header.started_ns + begin_s * S
        self.writer: BlockWriter = segment.writer("cell", Stamp(self._begin_ns, begin_s * S))
        settings = TriggerSettings(**trigger)  # type: ignore[arg-type]
        self.work = TriggeredRecorder(
            InstanceFollower(segment, start, selection),
            Settings(directory=str(folder), buffer_mb=buffer_mb),
            settings,
            "supervised",
            no_attachments,
        )
        self._next = 1

    def publish(self, count: int, **options: object) -> None:
        for _ in range(count):
            self.writer.at_ns = self._begin_ns + self._next * S
            self.writer.publish(self._next.to_bytes(2, "big"), cycle=self._next, **options)  # type: ignore[arg-type]
            self._next += 1
        self.work.turn()
        self.work.tend()

    def writes(self) -> bool:
        """Whether it is at a file."""
        return self.work.file is not None

    def close(self) -> list[list[int]]:
        """The numbers of the frames in each file."""
        assert self.work.close() == []
        found = files(self.folder)
        for file in found:
            with Reader(file) as reader:
                assert check(reader).whole
            assert gaps(file) == []
        return [numbers(file) for file in found]


def test_a_file_holds_the_seconds_before_and_after(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 20", before_s=5, after_s=3)
    bench.publish(19)
    assert (bench.work.file, list(tmp_path.iterdir())) == (None, [])
    bench.publish(2)
    assert bench.writes()
    bench.publish(20)
    assert bench.work.file is None
    assert bench.close() == [list(range(15, 24))]
    with Reader(files(tmp_path)[0]) as reader:
        list(reader.messages())
        assert reader.about["trigger"] == "cell/count = 20"
        assert int(reader.about["triggered_ns"]) > 0


def test_what_comes_in_one_turn_is_cut_exactly(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 20 or cell/count = 40", before_s=5, after_s=3)
    bench.publish(60)
    assert bench.close() == [list(range(15, 24)), list(range(35, 44))]


def test_one_that_comes_meanwhile_prolongs_the_file(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count mod 20 < 3 and cell/count > 18", before_s=2, after_s=4)
    bench.publish(35)
    assert bench.close() == [list(range(18, 27))]


def test_the_times_of_frames_need_not_be_the_hosts(instance: str, tmp_path: Path) -> None:
    """A replay that stood, or plays slowly, is behind by as much."""
    with Segment.create(instance, [spec("cell")], [], origin=Origin(3_600 * S, 0)) as segment:
        bench = Bench(segment, tmp_path, when="cell/count = 20", before_s=5, after_s=3, begin_s=0)
        for _ in range(40):
            bench.publish(1)
        assert bench.close() == [list(range(15, 24))]
        segment.unlink()


def test_it_may_be_of_a_source_that_is_not_recorded(segment: Segment, tmp_path: Path) -> None:
    segment.change(add=[spec("press")], retire=[])
    bench = Bench(
        segment, tmp_path, when="press/count = 1 and cell/count = 20", before_s=5, after_s=3,
        selection=Selection(["cell"]),
    )  # fmt: skip
    press = segment.writer("press", Stamp(segment.header.started_ns + 100_000 * S, 100_000 * S))
    for count in (10, 8, 12):  # what it publishes beside the 18 is within the file's time
        bench.publish(count)
        press.at_ns = bench.writer.at_ns
        publish(press, 1, first=1)
    assert bench.close() == [list(range(15, 24))]
    with Reader(files(tmp_path)[0]) as reader:
        list(reader.messages())
        assert {channel.source for channel in reader.channels.values() if channel.source} == {"cell"}


def test_two_files_do_not_overlap(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 10 or cell/count = 14", before_s=8, after_s=2)
    bench.publish(30)
    assert bench.close() == [list(range(2, 13)), [13, 14, 15, 16]]


def test_an_edge_and_a_bad_frame(segment: Segment, tmp_path: Path) -> None:
    """A frame of bad quality is not known to be anything."""
    bench = Bench(segment, tmp_path, when="rising(cell/count >= 5) or cell/count = 9", before_s=0, after_s=0)
    bench.publish(8)
    bench.publish(1, quality=Quality.BAD)
    bench.publish(5)
    assert bench.close() == [[5]]


def test_events_stand_where_they_were_and_other_sources_are_recorded_too(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 6", before_s=2, after_s=1)
    bench.publish(4)
    bench.writer.event(Record(EventKind.QUALITY, "within"))
    bench.publish(20)
    bench.close()
    [file] = files(tmp_path)
    assert numbers(file, kind=Event) == [2], "the first one, of the start, was long before"
    assert numbers(file) == [4, 5, 6, 7]


def test_memory_is_bounded(segment: Segment, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 90", before_s=50, after_s=0, before_mb=802 * 10 / 1e6)
    bench.publish(91)
    assert bench.close() == [list(range(80, 91))], "ten, and the one that fires"
    assert caplog.text.count("recorder.trigger.before_mb has no room for more") == 1


def test_what_ran_over_before_is_no_gap_of_a_file(segment: Segment, tmp_path: Path) -> None:
    publish(segment.writer("cell"), 2 * RING)
    bench = Bench(segment, tmp_path, when="cell/count = 3", before_s=1, after_s=0)
    bench.publish(4)
    assert len(bench.close()) == 1


def test_a_reload_that_takes_the_register_away_and_brings_it_back(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 7", before_s=0, after_s=0)
    segment.change(add=[spec("cell2")], retire=["cell"])
    bench.work.turn()
    segment.change(add=[spec("cell", OTHER)], retire=[])
    writer = segment.writer("cell")
    writer.publish(bytes(4) + b"\0\7", cycle=1)
    bench.work.turn()
    assert bench.work.file
    assert bench.work.close() == []


def test_what_is_no_condition_is_refused(segment: Segment, tmp_path: Path) -> None:
    for when in ("cell/nothing > 5", "cell/count >"):
        with pytest.raises(ConfigError, match="when: "):
            Bench(segment, tmp_path, when=when)


def test_without_a_folder_it_says_so_and_goes_on_waiting(segment: Segment, tmp_path: Path) -> None:
    folder = tmp_path / "file"
    folder.touch()
    bench = Bench(segment, folder, when="cell/count = 5 or cell/count = 7", before_s=9, after_s=0)
    bench.publish(6)
    assert "cannot make a recording in" in bench.work.problem
    folder.unlink()
    bench.publish(3)
    assert bench.work.problem == ""
    assert bench.close() == [[1, 2, 3, 4, 5, 6, 7]]


def test_while_the_disk_takes_nothing_no_more_waits_than_may(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Each time has a file of its own; what waits for the disk is of all of them."""
    full = True

    def pwrite(fd: int, data: bytes, offset: int, write: Callable[[int, bytes, int], int] = os.pwrite) -> int:
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(fd, data, offset)

    monkeypatch.setattr(os, "pwrite", pwrite)
    monkeypatch.setattr(output_module, "RETRY_S", 0.01)
    bench = Bench(segment, tmp_path, when="cell/count mod 10 = 0", before_s=2, after_s=2, buffer_mb=0.005)
    for _ in range(20):
        bench.publish(10)
    assert 1 < len(list(tmp_path.iterdir())) < 10
    assert "No space left on device" in bench.work.problem
    assert caplog.text.count("no new file is started while") == 1
    full = False
    until(lambda: all(series.ended for series in bench.work._ending), "what waits is written")
    bench.publish(10)
    assert bench.close()[-1] == [208, 209, 210]


def test_the_process_says_what_it_waits_for_and_ends_by_itself(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    trigger = {"when": "cell/count = 5", "before_s": 60, "after_s": 0.2}
    with Process(segment, tmp_path, trigger=trigger) as process:
        until(lambda: process.slot.report.note == "to a file as soon as its trigger comes", "that it waits")
        publish(writer, 6)
        until(lambda: process.slot.report.note.endswith(".mem"), "its file")
        until(lambda: process.slot.report.note == "to a file as soon as its trigger comes", "that it waits again")
        assert process.stop() == 0
    [file] = files(process.folder)
    assert numbers(file) == [1, 2, 3, 4, 5, 6]


def test_a_recorder_that_was_killed_within_one_goes_on(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    trigger = {"when": "cell/count = 5", "before_s": 60, "after_s": 60}
    with Process(segment, tmp_path, trigger=trigger) as first:
        until(lambda: first.slot.report.note == "to a file as soon as its trigger comes", "that it waits")
        publish(writer, 10)
        until(lambda: first.counts("bytes") > 2000, "its file")
        kill(first.popen.pid)
        first.popen.wait()
    publish(writer, 5, first=10)
    with Process(segment, tmp_path, trigger=trigger) as second:
        until(lambda: second.counts("frames") > 0, "the rest")
        assert second.stop() == 0
    assert [number for file in files(first.folder) for number in numbers(file)] == list(range(1, 16))


def test_from_outside(segment: Segment, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = ["record", "--instance", segment.instance, "-o", str(tmp_path), "--for", "0.01"]
    assert main([*record, "--when", "cell/count > 5"]) == 0
    assert f"to {tmp_path} whenever cell/count > 5" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert main([*record, "--when", "cell/count >"]) == 1
    assert "when: at character 13: expected" in capsys.readouterr().err
