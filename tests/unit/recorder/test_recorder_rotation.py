"""Rotation of files, and the removal of old ones."""

from __future__ import annotations

import os
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.dump import main
from shmio.config import Recorder as Settings
from shmio.connectors.replay.recording import Recording
from shmio.local.time_control import Coordinator
from shmio.recorder import file_output as output_module
from shmio.recorder.file_output import Output
from shmio.recorder.housekeeping import Housekeeper
from shmio.recorder.instance_follower import InstanceFollower
from shmio.recorder.recorder import RotatingRecorder, no_attachments
from shmio.recording.block_follower import BlockEntry
from shmio.recording.check import check
from shmio.recording.format.encoding import BlockPosition, Gap, Reason
from shmio.recording.reading.reader import Reader
from shmio.segment import Event, EventKind, Record, Segment
from shmio.testing.cell import until
from tests.unit.recorder.harness import RING, Process, gaps, numbers, publish, read
from tests.unit.recorder.test_steps import marks

DAY_S = 86_400


def tend(work: RotatingRecorder) -> None:
    """Wait until the previous file is complete on disk, then rotate."""
    work.recorder._writer.flush()
    until(lambda: all(old.output.ended for old in work._ending), "the previous file")
    work.tend()


def series(segment: Segment, folder: Path, **settings: Any) -> RotatingRecorder:
    return RotatingRecorder(
        InstanceFollower(segment), Settings(directory=str(folder), **settings), "supervised", no_attachments
    )


def files(folder: Path) -> list[Path]:
    """Return the files in the order in which they were started."""
    found = []
    for file in folder.glob("*.mem"):
        with Reader(file) as reader:
            list(reader.messages())
            found.append((int(reader.about["recording_ns"]), file))
    return [file for _, file in sorted(found)]


def test_rotation_neither_loses_nor_repeats_a_frame(segment: Segment, tmp_path: Path) -> None:
    work = series(segment, tmp_path, rotate_mb=0.004, rotate_min=0)
    writer = segment.writer("cell")
    for turn in range(60):
        publish(writer, 10, first=10 * turn)
        writer.event(Record(EventKind.QUALITY, "so so"))
        work.run_once()
        tend(work)
    assert work.close() == []
    found = files(tmp_path)
    assert len(found) > 3
    assert [number for file in found for number in numbers(file)] == list(range(1, 601))
    assert [number for file in found for number in numbers(file, kind=Event)] == list(range(1, 62))
    assert [gap for file in found for gap in gaps(file)] == []
    for before, file in pairwise(found[:-1]):  # the last file may be empty
        with Reader(before) as reader:
            assert check(reader).whole
            assert reader.records.footer()
            *_, last = (message for message in reader.messages() if message.channel.source == "cell")
        with Reader(file) as reader:
            begin = next(reader.messages()).channel
            end = BlockPosition(numbers(before)[-1], numbers(before, kind=Event)[-1], last.log_ns)
            assert reader.places[last.channel.section] == end
            assert begin.after == (numbers(before)[-1] if begin.topic == "cell/frames" else begin.after)


def test_a_gap_at_the_end_of_a_file_is_in_that_file(segment: Segment, tmp_path: Path) -> None:
    """An example is a writer that died, so that no later frame shows which frames the ring lost."""
    work = series(segment, tmp_path, rotate_mb=0.001)
    publish(segment.writer("cell"), 100)
    work.run_once()
    cell = work.tap.followers[0]
    gap = Gap("cell", cell.number, "frames", 101, 110, 10, Reason.OVERTAKEN, 0, 0)
    now_ns = work.tap.now()
    work.put([BlockEntry(now_ns, cell, gap)])
    work.recorder._writer.flush()
    work.tend()
    assert work.close() == []
    first, second = files(tmp_path)
    assert gaps(first) == [gap]
    with Reader(second) as reader:
        list(reader.messages())
        assert reader.places[cell.block.section] == BlockPosition(110, 1, now_ns)


def test_frames_lost_between_two_files_are_one_gap_in_the_second(segment: Segment, tmp_path: Path) -> None:
    work = series(segment, tmp_path, rotate_mb=0.001)
    writer = segment.writer("cell")
    publish(writer, 100)
    work.run_once()
    publish(writer, 3 * RING, first=100)
    work.recorder._writer.flush()
    work.tend()
    assert work.close() == []
    first, second = files(tmp_path)
    [gap] = gaps(second)
    assert gaps(first) == []
    assert numbers(first) == list(range(1, 101))
    assert (gap.first, numbers(second)) == (101, list(range(gap.last + 1, 3 * RING + 101)))


def test_rotation_by_time(segment: Segment, tmp_path: Path) -> None:
    with Process(segment, tmp_path, rotate_min=0.01) as process:
        writer = segment.writer("cell")

        def enough() -> bool:
            if process.counts("frames") == writer.block.ring.head():  # on a busy host the ring must not overflow
                publish(writer, 1, first=writer.block.ring.head())
            return len(list(process.folder.glob("*.mem"))) >= 3

        until(enough, "three files")
        process.stop()
    found = files(process.folder)
    assert [number for file in found for number in numbers(file)] == list(range(1, writer.block.ring.head() + 1))


def test_a_step_at_a_rotation_is_recorded_once(segment: Segment, tmp_path: Path) -> None:
    coordinator = Coordinator(segment)
    work = series(segment, tmp_path, rotate_mb=0.0001)
    for _ in range(6):
        coordinator.step(1_000_000)
        work.run_once()
        tend(work)
    done = work.tap.done
    assert work.close() == []
    coordinator.close()
    found = files(tmp_path)
    assert len(found) > 2
    assert [mark.step for file in found for mark in marks(file)] == list(range(done - 5, done + 1))


def test_no_new_file_is_started_while_the_disk_fails(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(output_module, "RETRY_S", 0.01)
    work = series(segment, tmp_path, rotate_mb=0.001)
    with monkeypatch.context() as broken:

        def refuse(output: Output, _: bytes) -> bool:
            output.error = "No space left on device"
            return False

        broken.setattr(Output, "_put", refuse)
        publish(segment.writer("cell"), 100)
        work.run_once()
        work.recorder._writer.flush()
        until(lambda: bool(work.problem), "the problem")
        work.tend()
        assert len(list(tmp_path.iterdir())) == 1
    until(lambda: not work.problem, "the end of the problem")
    work.tend()
    assert work.close() == []
    assert len(files(tmp_path)) == 2


def test_a_file_is_written_only_after_the_previous_one(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("one", "two")]
    outputs: list[Output] = []
    for path in paths:
        fd = os.open(path, os.O_WRONLY | os.O_CREAT, 0o600)
        outputs.append(Output(path, fd, limit_bytes=100, after=outputs[0] if outputs else None))
    first, second = outputs
    second.write(b"two")
    second.flush()
    first.write(b"one")
    first.flush()
    until(lambda: first.written == 3, "the first file")
    assert paths[1].read_bytes() == b""
    first.end()
    assert second.close(30)
    assert paths[1].read_bytes() == b"two"
    assert first.close(0)


def test_a_file_stays_empty_if_the_previous_one_could_not_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If only the second file had frames, the first file's frames would be in no file and in no gap."""
    monkeypatch.setattr(Output, "_put", lambda *_: False)
    outputs: list[Output] = []
    for name in ("one", "two"):
        fd = os.open(tmp_path / name, os.O_WRONLY | os.O_CREAT, 0o600)
        outputs.append(Output(tmp_path / name, fd, limit_bytes=100, after=outputs[0] if outputs else None))
        outputs[-1].write(b"data")
    assert not outputs[0].close(30)
    assert not outputs[1].close(30)
    assert "one, was not written completely" in outputs[1].problem
    assert (tmp_path / "two").read_bytes() == b""


def test_rotation_writes_no_file_after_one_that_could_not_be_written(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is slow when the new file is started, and then accepts no more data of the old file."""
    answered, put = threading.Event(), Output._put
    work = series(segment, tmp_path, rotate_mb=0.001)
    first = work.recorder.output

    def held(output: Output, piece: bytes) -> bool:
        if output is not first:
            return put(output, piece)
        answered.wait(30)
        return False

    monkeypatch.setattr(Output, "_put", held)
    publish(segment.writer("cell"), 100)
    work.run_once()
    work.recorder._writer.flush()
    work.tend()
    second = work.recorder.output
    assert second is not first
    publish(segment.writer("cell"), 1)
    work.run_once()
    answered.set()
    assert len(work.close()) == 2
    assert second.path.read_bytes() == b""


# ---- retention -------------------------------------------------------------------------------------------------------


def recorded(segment: Segment, folder: Path, age_days: float, by: str = "supervised") -> Path:
    """Make a closed recording of this age."""
    work = RotatingRecorder(InstanceFollower(segment), Settings(directory=str(folder)), by, no_attachments)
    publish(segment.writer("cell"), 100)
    assert work.close() == []
    file = work.recorder.output.path
    moment_s = time.time() - age_days * DAY_S
    os.utime(file, (moment_s, moment_s))
    return file


def keep(segment: Segment, folder: Path, present: Path | None = None, **settings: Any) -> set[Path]:
    """Clean up the folder; return the remaining files."""
    writing = {present} if present else set()
    keeper = Housekeeper(segment.instance, Settings(directory=str(folder), **settings), "supervised", lambda: writing)
    keeper.check_folder()
    return set(folder.iterdir())


def test_nothing_is_deleted_by_default(segment: Segment, tmp_path: Path) -> None:
    old = recorded(segment, tmp_path, 4000)
    assert keep(segment, tmp_path) == {old}


def test_retention_by_age(segment: Segment, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    old, young, present = (recorded(segment, tmp_path, days) for days in (8, 6, 9))
    assert keep(segment, tmp_path, present, keep_days=7) == {young, present}
    assert f"deleted {old}: it is 8.0 days old, but recorder.keep_days is 7" in caplog.text


def test_retention_by_size_deletes_the_oldest_first(segment: Segment, tmp_path: Path) -> None:
    files = [recorded(segment, tmp_path, days) for days in (1, 3, 2, 0)]
    size = sum(file.stat().st_size for file in files) - files[1].stat().st_size
    assert keep(segment, tmp_path, keep_mb=(size + 0.5) / 1e6) == {files[0], files[2], files[3]}
    assert keep(segment, tmp_path, files[3], keep_mb=1e-6) == {files[3]}


def test_a_file_that_is_being_played_is_not_deleted(segment: Segment, tmp_path: Path) -> None:
    """A replay of the file would not find it after a restart."""
    old, older = recorded(segment, tmp_path, 8), recorded(segment, tmp_path, 9)
    with Recording([old]):
        assert keep(segment, tmp_path, keep_days=7) == {old}
    assert not older.exists()
    assert keep(segment, tmp_path, keep_days=7) == set()


def test_a_file_that_was_in_use_is_closed_later(segment: Segment, tmp_path: Path) -> None:
    whole = recorded(segment, tmp_path, 0)
    killed = tmp_path / f"{segment.instance}-20200101T000000Z.mem"
    killed.write_bytes(whole.read_bytes()[:-100])
    keeper = Housekeeper(segment.instance, Settings(directory=str(tmp_path)), "supervised", set)
    with Recording([killed]):
        keeper.check_folder()
        with Reader(killed) as reader:
            assert reader.records.footer() is None
    keeper.check_folder()
    with Reader(killed) as reader:
        assert reader.records.footer() is not None


def test_files_that_the_recorder_did_not_write_are_never_deleted(segment: Segment, tmp_path: Path) -> None:
    name = segment.instance
    strange = {recorded(segment, tmp_path, 9, by="shmio-dump")}
    own = recorded(segment, tmp_path, 9)
    other = tmp_path / f"{name}-20200101T000000Z.mem"
    other.write_bytes(own.read_bytes().replace(name.encode(), b"x" * len(name)))  # only its name is the instance's
    link = tmp_path / f"{name}-20200101T000001Z.mem"
    link.symlink_to(other)
    nonsense = tmp_path / f"{name}-20200101T000002Z.mem"
    nonsense.write_bytes(b"no recording")
    copy = tmp_path / f"copy of {own.name}"
    copy.write_bytes(own.read_bytes())
    longer = tmp_path / f"{name}-test-20200101T000000Z.mem"
    longer.write_bytes(own.read_bytes())
    made = tmp_path / f"{name}-20200101T000004Z.mem"
    assert main(["cut", str(own), "-o", str(made)]) == 0
    strange |= {other, link, nonsense, copy, longer, made}
    if os.geteuid() == 0:
        foreign = tmp_path / f"{name}-20200101T000003Z.mem"
        foreign.write_bytes(own.read_bytes())
        os.chown(foreign, 65534, 65534)
        strange.add(foreign)
    for file in strange:
        os.utime(file, (1, 1), follow_symlinks=False)
    assert keep(segment, tmp_path, keep_days=7, keep_mb=1e-6) == strange


def test_a_file_that_cannot_be_deleted_is_reported_once(
    segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    old = recorded(segment, tmp_path, 9)
    keeper = Housekeeper(segment.instance, Settings(directory=str(tmp_path), keep_days=7), "supervised", set)

    def refuse(_: Path) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as readonly:
        readonly.setattr(Path, "unlink", refuse)
        keeper.check_folder()
        keeper.check_folder()
    assert (
        caplog.text.count(
            f"the recorder cannot delete {old}: Permission denied; it should be deleted because it is 9.0 days old"
        )
        == 1
    )
    keeper.check_folder()
    assert not old.exists()


def test_the_process_deletes_old_files_as_configured(segment: Segment, tmp_path: Path) -> None:
    old = recorded(segment, tmp_path / "dumps", 9)
    with Process(segment, tmp_path, keep_days=7) as process:
        until(lambda: not old.exists(), "the old file deleted")
        publish(segment.writer("cell"), 3)
        process.stop()
    assert ": it is 9.0 days old" in process.log.read_text()
    assert [message.channel.source for message in read(process.file)]
