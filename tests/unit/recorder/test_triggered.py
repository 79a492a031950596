"""Recordings of the time around a trigger."""

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
    """A triggered recording of the source ``cell``.

    The source has one frame a second. The tenth frame has the value 10.
    """

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
        """Start the recording.

        ``begin_s``: time of the first frame, in seconds after the instance's start.
        """
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
        self.work.run_once()
        self.work.tend()

    def writes(self) -> bool:
        """Return whether the recording is writing a file."""
        return self.work.file is not None

    def close(self) -> list[list[int]]:
        """Close the recording. Return the numbers of the frames in each file."""
        assert self.work.close() == []
        found = files(self.folder)
        for file in found:
            with Reader(file) as reader:
                assert check(reader).whole
            assert gaps(file) == []
        return [numbers(file) for file in found]


def test_a_file_has_the_seconds_before_and_after_the_trigger(segment: Segment, tmp_path: Path) -> None:
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


def test_frames_of_one_turn_are_cut_exactly(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 20 or cell/count = 40", before_s=5, after_s=3)
    bench.publish(60)
    assert bench.close() == [list(range(15, 24)), list(range(35, 44))]


def test_another_trigger_prolongs_the_file(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count mod 20 < 3 and cell/count > 18", before_s=2, after_s=4)
    bench.publish(35)
    assert bench.close() == [list(range(18, 27))]


def test_the_times_of_frames_may_differ_from_the_hosts_clock(instance: str, tmp_path: Path) -> None:
    """The frames of a paused or slow replay lag behind the host's clock."""
    with Segment.create(instance, [spec("cell")], [], origin=Origin(3_600 * S, 0)) as segment:
        bench = Bench(segment, tmp_path, when="cell/count = 20", before_s=5, after_s=3, begin_s=0)
        for _ in range(40):
            bench.publish(1)
        assert bench.close() == [list(range(15, 24))]
        segment.unlink()


def test_the_trigger_may_be_on_a_source_that_is_not_recorded(segment: Segment, tmp_path: Path) -> None:
    segment.change(add=[spec("press")], retire=[])
    bench = Bench(
        segment, tmp_path, when="press/count = 1 and cell/count = 20", before_s=5, after_s=3,
        selection=Selection(["cell"]),
    )  # fmt: skip
    press = segment.writer("press", Stamp(segment.header.started_ns + 100_000 * S, 100_000 * S))
    for count in (10, 8, 12):  # press publishes the 18 within the file's time
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


def test_a_rising_edge_and_a_bad_frame(segment: Segment, tmp_path: Path) -> None:
    """A condition is never true on a frame of bad quality."""
    bench = Bench(segment, tmp_path, when="rising(cell/count >= 5) or cell/count = 9", before_s=0, after_s=0)
    bench.publish(8)
    bench.publish(1, quality=Quality.BAD)
    bench.publish(5)
    assert bench.close() == [[5]]


def test_only_events_within_the_files_time_are_recorded(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 6", before_s=2, after_s=1)
    bench.publish(4)
    bench.writer.event(Record(EventKind.QUALITY, "within"))
    bench.publish(20)
    bench.close()
    [file] = files(tmp_path)
    assert numbers(file, kind=Event) == [2], "the start event was before the file's time"
    assert numbers(file) == [4, 5, 6, 7]


def test_the_memory_for_the_time_before_is_bounded(
    segment: Segment, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 90", before_s=50, after_s=0, before_mb=802 * 10 / 1e6)
    bench.publish(91)
    assert bench.close() == [list(range(80, 91))], "ten frames, and the one that triggers"
    assert caplog.text.count("raise recorder.trigger.before_mb") == 1


def test_frames_lost_before_the_files_time_are_not_a_gap(segment: Segment, tmp_path: Path) -> None:
    publish(segment.writer("cell"), 2 * RING)
    bench = Bench(segment, tmp_path, when="cell/count = 3", before_s=1, after_s=0)
    bench.publish(4)
    assert len(bench.close()) == 1


def test_a_reload_removes_the_triggers_register_and_restores_it(segment: Segment, tmp_path: Path) -> None:
    bench = Bench(segment, tmp_path, when="cell/count = 7", before_s=0, after_s=0)
    segment.change(add=[spec("cell2")], retire=["cell"])
    bench.work.run_once()
    segment.change(add=[spec("cell", OTHER)], retire=[])
    writer = segment.writer("cell")
    writer.publish(bytes(4) + b"\0\7", cycle=1)
    bench.work.run_once()
    assert bench.work.file
    assert bench.work.close() == []


def test_an_invalid_condition_is_refused(segment: Segment, tmp_path: Path) -> None:
    for when in ("cell/nothing > 5", "cell/count >"):
        with pytest.raises(ConfigError, match="when: "):
            Bench(segment, tmp_path, when=when)


def test_without_a_folder_it_reports_that_and_keeps_waiting(segment: Segment, tmp_path: Path) -> None:
    folder = tmp_path / "file"
    folder.touch()
    bench = Bench(segment, folder, when="cell/count = 5 or cell/count = 7", before_s=9, after_s=0)
    bench.publish(6)
    assert "cannot create a recording in" in bench.work.problem
    folder.unlink()
    bench.publish(3)
    assert bench.work.problem == ""
    assert bench.close() == [[1, 2, 3, 4, 5, 6, 7]]


def test_the_waiting_data_are_bounded_while_the_disk_fails(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Each trigger starts a file. The total size of the data that wait for the disk is limited."""
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
    assert caplog.text.count("but the recorder starts no new file") == 1
    full = False
    until(lambda: all(series.ended for series in bench.work._ending), "the waiting data written")
    bench.publish(10)
    assert bench.close()[-1] == [208, 209, 210]


def test_the_process_reports_that_it_waits_and_closes_the_file_by_itself(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    trigger = {"when": "cell/count = 5", "before_s": 60, "after_s": 0.2}
    with Process(segment, tmp_path, trigger=trigger) as process:
        until(lambda: process.slot.report.note == "to a file as soon as its trigger fires", "the trigger awaited")
        publish(writer, 6)
        until(lambda: process.slot.report.note.endswith(".mem"), "its file")
        until(lambda: process.slot.report.note == "to a file as soon as its trigger fires", "the trigger awaited again")
        assert process.stop() == 0
    [file] = files(process.folder)
    assert numbers(file) == [1, 2, 3, 4, 5, 6]


def test_a_recorder_killed_during_a_triggered_file_continues_it(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    trigger = {"when": "cell/count = 5", "before_s": 60, "after_s": 60}
    with Process(segment, tmp_path, trigger=trigger) as first:
        until(lambda: first.slot.report.note == "to a file as soon as its trigger fires", "the trigger awaited")
        publish(writer, 10)
        until(lambda: first.counts("bytes") > 2000, "its file")
        kill(first.popen.pid)
        first.popen.wait()
    publish(writer, 5, first=10)
    with Process(segment, tmp_path, trigger=trigger) as second:
        until(lambda: second.counts("frames") > 0, "the remaining frames")
        assert second.stop() == 0
    assert [number for file in files(first.folder) for number in numbers(file)] == list(range(1, 16))


def test_shmio_dump_record_with_a_trigger(segment: Segment, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = ["record", "--instance", segment.instance, "-o", str(tmp_path), "--for", "0.01"]
    assert main([*record, "--when", "cell/count > 5"]) == 0
    assert f"to {tmp_path} whenever cell/count > 5" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert main([*record, "--when", "cell/count >"]) == 1
    assert "when: at character 13: expected" in capsys.readouterr().err
