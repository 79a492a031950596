"""The recorder's process, which is killed, restarted, or has a full disk. The tests check its files."""

from __future__ import annotations

import os
import resource
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from shmio.cli.dump import main
from shmio.errors import RecordingError
from shmio.recording.check import check
from shmio.recording.format.encoding import Reason
from shmio.recording.format.records import MAGIC
from shmio.recording.reading.reader import Reader
from shmio.segment import Activity, BlockSpec, Event, Frame, Segment
from shmio.testing.cell import kill, until
from tests.unit.recorder.harness import OTHER, RING, Process, gaps, numbers, publish, read, spec


def written(process: Process) -> list[int]:
    """Return the numbers of the frames in the recorder's file so far."""
    return numbers(process.file) if process.file.is_file() and process.file.stat().st_size else []


def ready(process: Process) -> bool:
    return process.slot.report.pid == process.popen.pid and process.slot.report.note.startswith("to ")


def test_it_records_reports_counters_and_closes_its_file(
    segment: Segment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "supervisor.toml").write_text(
        f'[instance]\nname = "{segment.instance}"\n[[source]]\nname = "cell"\nconnector = "x"\nlayout = "a.db"\n'
    )
    (tmp_path / "a.db").write_text("the source")
    with Process(segment, tmp_path) as process:
        publish(segment.writer("cell"), 5)
        until(lambda: process.counts("frames") == 5 and process.counts("events") == 1, "the counters")
        until(lambda: process.counts("bytes") > 0, "bytes")
        file = process.file
        assert file.name.startswith(f"{segment.instance}-")
        assert process.stop() == 0
    assert process.slot.report.activity is Activity.STOPPING
    assert numbers(file) == [1, 2, 3, 4, 5]
    with Reader(file) as reader:
        list(reader.messages())
        assert reader.records.closed
        assert {"config/supervisor.toml", "sources/cell/1/a.db"} < set(reader.attachments)
        assert reader.about["recorder"] == "supervised"
    assert main(["info", str(file)]) == 0
    assert "; recorded by the instance's own recorder, shmio " in capsys.readouterr().out
    assert "the recorder recorded 5 frames and 1 events; it missed 0" in process.log.read_text()


def test_a_killed_recorders_file_is_readable_and_its_successor_continues(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    with Process(segment, tmp_path) as first:
        publish(writer, 20)
        until(lambda: ready(first) and len(written(first)) == 20, "the published frames in the file")
        publish(writer, 30)
        kill(first.popen.pid)
        first.popen.wait()
    old = first.file
    kept = numbers(old)
    assert kept == list(range(1, len(kept) + 1))
    assert len(kept) >= 20
    with Reader(old) as reader:
        list(reader.messages())
        assert not reader.records.closed
    with Process(segment, tmp_path) as second:
        until(lambda: second.counts("frames") == 50 - len(kept), "the frames that the first had not written")
        assert second.file != old
        assert second.stop() == 0
    assert kept + numbers(second.file) == list(range(1, 51))
    assert gaps(second.file) == []
    assert numbers(old, kind=Event) == [1]
    assert numbers(second.file, kind=Event) == []


def test_frames_that_the_ring_no_longer_has_are_a_gap_after_the_predecessor(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    with Process(segment, tmp_path) as first:
        publish(writer, 10)
        until(lambda: first.counts("frames") == 10, "frames")
        old = first.file
        first.stop()
    publish(writer, 2 * RING)
    with Process(segment, tmp_path) as second:
        until(lambda: second.counts("frames") + second.counts("missed") == 2 * RING, "all frames, or missed ones")
        second.stop()
    [gap] = gaps(second.file)
    assert (gap.first, gap.reason) == (11, Reason.NOT_RUNNING)
    with Reader(old) as reader:
        before = [message.log_ns for message in reader.messages(lambda channel: channel.source == "cell")]
    assert gap.after_ns == before[-1]
    assert numbers(second.file) == list(range(gap.last + 1, 2 * RING + 11))
    assert second.counts("missed") == gap.count


def test_frames_recorded_in_another_folder_are_a_gap_marked_as_elsewhere(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    with Process(segment, tmp_path) as first:
        publish(writer, 10)
        until(lambda: first.counts("frames") == 10, "frames")
        old = first.file
        first.stop()
    publish(writer, 2 * RING)
    with Process(segment, tmp_path, directory=str(tmp_path / "other")) as second:
        until(lambda: second.counts("frames") + second.counts("missed") == 2 * RING + 10, "all frames, or missed ones")
        second.stop()
    assert f"{old.name} is not in this folder" in second.log.read_text()
    [file] = (tmp_path / "other").iterdir()
    [gap] = gaps(file)
    assert (gap.what, gap.first, gap.reason) == ("frames", 1, Reason.ELSEWHERE)


def test_the_previous_file_is_found_though_the_clock_was_set_back(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    files = []
    for turn, year in enumerate((2040, 2030, 2035)):
        with Process(segment, tmp_path) as process:
            publish(writer, 10, first=10 * turn)
            until(lambda: process.counts("frames") == 10, "the frames of this turn")
            process.stop()
        files.append(process.file.rename(process.file.with_name(f"{segment.instance}-{year}0101T000000Z.mem")))
    assert [numbers(file) for file in files] == [list(range(first, first + 10)) for first in (1, 11, 21)]
    assert [gap for file in files for gap in gaps(file)] == []


def test_events_are_not_recorded_again_by_later_recorders_of_a_quiet_cell(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    events: list[list[int]] = []
    for turn in range(3):
        with Process(segment, tmp_path) as process:
            publish(writer, 10, first=10 * turn)
            until(lambda: process.counts("frames") == 10, "the frames of this turn")
            process.stop()
        events.append(numbers(process.file, kind=Event))
    assert events == [[1], [], []]


def test_a_replaced_block_is_not_mistaken_for_the_earlier_one(segment: Segment, tmp_path: Path) -> None:
    publish(segment.writer("cell"), 20)
    with Process(segment, tmp_path) as process:
        until(lambda: process.counts("frames") == 20, "the old block's frames")
        process.stop()
    old = segment.blocks["cell"]
    spec = BlockSpec("cell", old.layout, old.period_ns, old.stale_ns, 1 << 22)
    segment.change(add=[spec], retire=["cell"])
    publish(segment.writer("cell"), 30)
    with Process(segment, tmp_path) as process:
        until(lambda: process.counts("frames") == 30, "all frames of the new block")
        process.stop()
    assert numbers(process.file) == list(range(1, 31))


def by_section(file: Path) -> dict[int, list[int]]:
    """Return the numbers of the frames of the source ``cell`` in a file, by section of the block."""
    found: dict[int, list[int]] = {}
    for channel, _, item in read(file):
        if isinstance(item, Frame) and channel.source == "cell":
            found.setdefault(channel.section, []).append(item.number)
    return found


def test_a_block_that_ended_while_no_recorder_ran_is_recorded_by_the_next(segment: Segment, tmp_path: Path) -> None:
    sections = [segment.blocks["cell"].section]
    with Process(segment, tmp_path) as process:
        publish(segment.writer("cell"), 10)
        until(lambda: process.counts("frames") == 10, "frames")
        process.stop()
        files = [process.file]
    publish(segment.writer("cell"), 3, first=10)
    segment.change(add=[spec("cell", OTHER)], retire=["cell"])
    sections.append(segment.blocks["cell"].section)
    publish(segment.writer("cell"), 3 * RING)
    segment.change(add=[spec("cell")], retire=["cell"])
    sections.append(segment.blocks["cell"].section)
    publish(segment.writer("cell"), 5)
    for published in (0, 2):  # the second run finds in the first one's file that the old blocks are done
        publish(segment.writer("cell"), published, first=5)
        with Process(segment, tmp_path) as process:
            until(lambda: ready(process), "its file")  # it records the waiting frames when it stops
            process.stop()
            files.append(process.file)
    first, second, third = map(by_section, files)
    [gap] = gaps(files[1])
    assert (gap.what, gap.first, gap.reason) == ("frames", 1, Reason.NOT_RUNNING)
    assert first == {sections[0]: list(range(1, 11))}
    assert second == {
        sections[0]: [11, 12, 13],
        sections[1]: list(range(gap.last + 1, 3 * RING + 1)),
        sections[2]: [1, 2, 3, 4, 5],
    }
    assert (third, gaps(files[2])) == ({sections[2]: [6, 7]}, [])
    for file in files:
        with Reader(file) as reader:
            assert check(reader).whole


def test_recordings_of_an_instance_with_a_longer_name_are_ignored(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    files = []
    for turn in range(2):
        with Process(segment, tmp_path) as process:
            publish(writer, 10, first=10 * turn)
            until(lambda: process.counts("frames") == 10, "the frames of this turn")
            process.stop()
        files.append(process.file)
        for number in range(300):
            (tmp_path / "dumps" / f"{segment.instance}-test-20990101T{number:06}Z.mem").write_bytes(b"")
    assert numbers(files[1]) == list(range(11, 21))


def test_a_file_that_is_not_a_recording_is_ignored(segment: Segment, tmp_path: Path) -> None:
    (tmp_path / "dumps").mkdir()
    (tmp_path / "dumps" / f"{segment.instance}-20990101T000000Z.mem").write_bytes(b"nonsense")
    publish(segment.writer("cell"), 3)
    with Process(segment, tmp_path) as process:
        until(lambda: process.counts("frames") == 3, "all frames")
        process.stop()
    assert "is not a recording" in process.log.read_text()


def test_files_of_other_users_are_ignored(segment: Segment, tmp_path: Path) -> None:
    """The folder has a recording of another user that claims all frames up to the tenth."""
    if os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    writer = segment.writer("cell")
    with Process(segment, tmp_path) as process:
        publish(writer, 10)
        until(lambda: process.counts("frames") == 10, "frames")
        process.stop()
    folder = process.folder
    strange = process.file.rename(folder / f"{segment.instance}-20980101T000000Z.mem")
    os.chown(strange, 65534, 65534)
    content, before = strange.read_bytes(), strange.stat()
    (folder / f"{segment.instance}-20980101T000001Z.mem").symlink_to(strange)
    os.mkfifo(folder / f"{segment.instance}-20980101T000002Z.mem")
    (folder / f"{segment.instance}-20980101T000003Z.mem").mkdir()
    for number in range(300):  # more than are searched
        os.link(strange, folder / f"{segment.instance}-20990101T{number:06}Z.mem")
    with Process(segment, tmp_path) as process:
        until(lambda: process.counts("frames") == 10, "the frames from the first on")
        process.stop()
        own = process.file
        assert ": this is not a regular file of this user" in process.log.read_text()
    after = strange.stat()
    assert (strange.read_bytes(), after.st_mtime_ns, after.st_ino) == (content, before.st_mtime_ns, before.st_ino)
    with Process(segment, tmp_path) as process:
        publish(writer, 1, first=10)
        until(lambda: process.counts("frames") == 1, "the frames since its own previous file")
        process.stop()
    assert numbers(own) + numbers(process.file) == list(range(1, 12))


def test_a_file_of_another_user_is_refused_when_it_is_opened(tmp_path: Path) -> None:
    file = tmp_path / "x.mem"
    file.write_bytes(MAGIC)
    Reader(file, own=True).close()
    (tmp_path / "link.mem").symlink_to(file)
    os.mkfifo(tmp_path / "pipe.mem")
    with pytest.raises(OSError, match="symbolic link"):
        Reader(tmp_path / "link.mem", own=True)
    with pytest.raises(RecordingError, match="is not a regular file"):
        Reader(tmp_path / "pipe.mem", own=True)
    if os.geteuid() == 0:
        os.chown(file, 65534, 65534)
        with pytest.raises(RecordingError, match=r"belongs to another user \(uid 65534"):
            Reader(file, own=True)


def test_without_room_it_reports_that_and_continues_once_there_is_room(segment: Segment, tmp_path: Path) -> None:
    """A limit on the file's size plays the full disk, because any user can set one."""
    writer = segment.writer("cell")
    with Process(segment, tmp_path, buffer_mb=0.02) as process:
        publish(writer, 10)
        until(lambda: ready(process) and len(written(process)) == 10, "frames in the file")
        file, size = process.file, process.file.stat().st_size
        _, hard = resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, (size + 100, hard))

        def costs() -> bool:
            publish(writer, 20, first=writer.block.ring.head())
            return process.counts("missed") > 0

        until(costs, "lost frames")
        until(lambda: f"{file}: File too large; " in process.slot.report.note, "the reason in the status")
        assert "File too large" in process.log.read_text()
        assert file.stat().st_size == size, "whole pieces only"
        resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, (hard, hard))
        until(lambda: ready(process), "a status without a problem")
        publish(writer, 1, first=writer.block.ring.head())
        until(lambda: file.stat().st_size > size, "more bytes in the file")
        process.stop()
    assert f"the recorder writes {file} again" in process.log.read_text()
    found, missed = numbers(file), gaps(file)
    assert {gap.reason for gap in missed} == {Reason.NO_ROOM}
    lost = [number for gap in missed for number in range(gap.first, gap.last + 1)]
    assert sorted(found + lost) == list(range(1, writer.block.ring.head() + 1))


BROKEN_DISK = """
import errno, os, pathlib
fsync, folder = os.fsync, pathlib.Path({folder!r})
def broken(fd):
    if (folder / "broken").exists():
        (folder / "broken").unlink()
        raise OSError(errno.EIO, "Input/output error")
    fsync(fd)
    (folder / "synced").write_text(str(os.fstat(fd).st_size))
os.fsync = broken
"""


@pytest.mark.parametrize("more", [5, 3 * RING])
def test_after_a_failed_fsync_it_continues_in_a_new_file(
    segment: Segment, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: int
) -> None:
    """A replaced fsync fails once, as if the disk had failed."""
    writer = segment.writer("cell")
    synced = tmp_path / "synced"
    with Process(segment, tmp_path, before=BROKEN_DISK.format(folder=str(tmp_path)), fsync_s=0.001) as process:
        publish(writer, 20)
        until(lambda: ready(process) and len(written(process)) == 20, "frames in the file")
        synced.unlink(missing_ok=True)
        publish(writer, 1, first=20)
        until(synced.exists, "an fsync of the earlier frames")
        (tmp_path / "broken").touch()
        publish(writer, more, first=21)
        old = process.file
        until(lambda: process.file != old, "another file")
        process.stop()
    new = process.file
    first, second = numbers(old), numbers(new)
    assert (first[0], second[-1]) == (1, 21 + more)
    assert "fsync failed (Input/output error): the data after byte" in process.log.read_text()
    assert f"may be lost; the recorder continues in {new}" in process.log.read_text()
    with Reader(new) as reader:
        assert check(reader).whole
        assert reader.about["doubtful"] == old.name
        assert 0 < int(reader.about["doubtful_from"]) < old.stat().st_size
    begin = second[0]
    for gap in gaps(new):
        assert gap.reason is Reason.UNSURE
        assert (gap.what, gap.last) == ("frames", begin - 1)
        begin = gap.first
    assert 10 < begin <= 22, "from the last position that fsync confirmed"
    assert (more > RING) == bool(gaps(new))
    assert main(["info", str(new)]) == 0
    assert f" of {old.name} may be lost, because the disk failed to store it" in capsys.readouterr().out


def test_a_failed_fsync_is_reported_until_a_new_file_is_started(segment: Segment, tmp_path: Path) -> None:
    writer = segment.writer("cell")
    with Process(segment, tmp_path, before=BROKEN_DISK.format(folder=str(tmp_path)), fsync_s=0.001) as process:
        publish(writer, 5)
        until(lambda: ready(process) and len(written(process)) == 5, "frames in the file")
        old = process.folder.rename(tmp_path / "moved") / process.file.name
        process.folder.touch()  # prevents a new file in it
        (tmp_path / "broken").touch()
        publish(writer, 1, first=5)
        until(lambda: "may be lost" in process.slot.report.note, "the possible loss in the status")
        (tmp_path / "synced").unlink()
        publish(writer, 1, first=6)
        until(lambda: len(numbers(old)) == 7, "a good write")
        until((tmp_path / "synced").exists, "a good fsync")
        until(lambda: process.counts("bytes") == old.stat().st_size, "a report of the write")
        assert "may be lost" in process.slot.report.note
        assert "cannot create a recording" in process.log.read_text()
        process.folder.unlink()
        until(lambda: ready(process) and process.file.name != old.name, "a new file")
        process.stop()
    assert numbers(process.file)[-1] == 7


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = os.geteuid() == 0 and (
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], capture_output=True, check=False
        ).returncode == 0
    )  # fmt: skip
    if not mounted:
        pytest.skip("only root can mount a small disk")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_a_full_disk_is_reported_until_there_is_room(segment: Segment, tmp_path: Path, small_disk: Path) -> None:
    ballast = small_disk / "ballast"
    writer = segment.writer("cell")
    with Process(segment, tmp_path, directory=str(small_disk / "dumps"), buffer_mb=0.02) as process:
        process.folder = small_disk / "dumps"
        publish(writer, 10)
        until(lambda: ready(process) and len(written(process)) == 10, "frames in the file")
        file = process.file
        with ballast.open("wb", buffering=0) as stream, suppress(OSError):
            while stream.write(b"\xa5" * 4096):
                pass

        def costs() -> bool:
            publish(writer, 20, first=writer.block.ring.head())
            return process.counts("missed") > 0

        until(costs, "lost frames")
        full = "No space left on device; make room, and the recorder continues"
        until(lambda: full in process.slot.report.note, "the reason in the status")
        ballast.unlink()
        until(lambda: ready(process), "a status without a problem")
        process.stop()
    found = numbers(file)
    lost = [number for gap in gaps(file) for number in range(gap.first, gap.last + 1)]
    assert sorted(found + lost) == list(range(1, writer.block.ring.head() + 1))
