"""Files that a killed recorder left. The next recorder closes them, wherever they end."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

import mcap.reader
import pytest
from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.recorder.finalise import finalise
from shmio.recorder.recorder import AttachedFile
from shmio.recording.check import check
from shmio.recording.format.records import HEAD
from shmio.recording.reading.reader import Reader
from shmio.segment import EventKind, Record, Segment
from shmio.testing.cell import kill, until
from tests.unit.recorder.harness import Process, gaps, numbers, publish, recorder

CHUNKS = 4


@pytest.fixture
def whole(segment: Segment, tmp_path: Path) -> Path:
    """Make a closed recording of several chunks."""
    files = [AttachedFile("config/supervisor.toml", "application/toml", b"[instance]\n", 5)]
    work = recorder(segment, tmp_path, attachments=lambda source, _: [] if source else files)
    for turn in range(CHUNKS):
        for source in ("cell", "press")[: 1 + turn % 2]:
            publish(segment.writer(source), 5, first=5 * turn)
            segment.writer(source).event(Record(EventKind.QUALITY, "so so"))
        work.run_once()
        work._writer.flush()
    assert work.close()
    return work.output.path


def records(file: Path, opcode: int) -> list[tuple[int, int]]:
    """Return where each record of a kind begins and ends."""
    with Reader(file) as reader:
        return [(found.start, found.at + found.size) for found in reader.records.walk() if found.opcode == opcode]


def messages(file: Path) -> list[tuple[str, int, bytes]]:
    """Return the messages that the mcap library reads through the index, with a check of every checksum."""
    with file.open("rb") as stream:
        reader = mcap.reader.make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
        assert summary.statistics.message_count == len(found)
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
        if found:
            times = [log_ns for _, log_ns, _ in found]
            assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (
                min(times),
                max(times),
            )
        assert [item.name for item in reader.iter_attachments()][:1] == ["config/supervisor.toml"]
        assert [item.name for item in reader.iter_metadata()][:1] == ["shmio"]
        return found


def expected(content: bytes, folder: Path, size: int) -> list[tuple[str, int, bytes]]:
    """Return the messages that are complete if the file ends at ``size`` bytes, read from front to back."""
    part = folder / "part"
    part.write_bytes(content[:size])
    with part.open("rb") as stream:
        found = mcap.reader.NonSeekingReader(stream).iter_messages(log_time_order=False)
        kept: list[tuple[str, int, bytes]] = []
        try:
            for _, channel, message in found:
                kept.append((channel.topic, message.log_time, message.data))
        except Exception:  # noqa: BLE001  the file ends within a record
            pass
    return sorted(kept)


def test_the_closed_file_equals_the_recorders_own(whole: Path, tmp_path: Path) -> None:
    content = whole.read_bytes()
    [(end, _)] = records(whole, Opcode.DATA_END)
    whole.write_bytes(content[:end])
    os.utime(whole, (1, 1))
    assert finalise(whole)
    assert whole.read_bytes() == content
    assert whole.stat().st_mtime == 1, "the time of the last recording is kept"
    assert len(messages(whole)) > CHUNKS


def test_a_file_cut_anywhere_after_its_last_chunk_began_is_closed(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file may also end within a summary, because the process that wrote the summary was killed, too."""
    monkeypatch.setattr(os, "fsync", lambda _: None)  # too slow for a thousand files
    content = whole.read_bytes()
    last, end = records(whole, Opcode.CHUNK)[-1]
    file = tmp_path / "cut.mem"
    for size in (*range(last, end + 1), *range(end + 2, len(content), 7)):
        file.write_bytes(content[:size])
        before = expected(content, tmp_path, size)
        assert finalise(file)
        assert sorted(messages(file)) == before
        assert file.read_bytes()[:last] == content[:last]
        with Reader(file) as reader:
            assert check(reader).whole


def test_zeros_at_the_end_after_a_power_failure(whole: Path, tmp_path: Path) -> None:
    content = whole.read_bytes()
    begin, end = records(whole, Opcode.CHUNK)[-1]
    for size, zeros in ((begin, 5000), (begin, 3 << 20), (end, 4096)):
        whole.write_bytes(content[:size] + bytes(zeros))
        before = expected(content, tmp_path, size)
        assert finalise(whole)
        assert sorted(messages(whole)) == before


@pytest.mark.parametrize("damaged", [1, 2, CHUNKS])
def test_damaged_chunks_at_the_end_are_cut_off(
    whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, damaged: int
) -> None:
    """With all messages before them, the file is valid for programs that read it from front to back."""
    [(over, _)] = records(whole, Opcode.DATA_END)
    content = bytearray(whole.read_bytes()[:over])
    chunks = records(whole, Opcode.CHUNK)
    for _, end in chunks[-damaged:]:
        content[end - 5] ^= 0xFF  # the indexes after it are intact
    begin = chunks[-damaged][0]
    before = expected(bytes(content), tmp_path, begin)
    whole.write_bytes(content)
    assert finalise(whole)
    assert sorted(messages(whole)) == before
    with whole.open("rb") as stream:
        found = mcap.reader.NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        assert sorted((channel.topic, message.log_time, message.data) for _, channel, message in found) == before
    with Reader(whole) as reader:
        assert check(reader).whole
    assert f"{whole} ended with {damaged} damaged chunk" in caplog.text


@pytest.mark.parametrize("damaged", [0, 1])
def test_a_chunk_of_unknown_compression_is_not_cut_off(whole: Path, damaged: int) -> None:
    """Another program may have written it, such as one that compresses recordings again."""
    content = whole.read_bytes()
    chunks = records(whole, Opcode.CHUNK)
    begin, end = chunks[-1 - damaged]
    chunk = content[begin:end].replace(b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4", 1)
    packed = chunk[:1] + (len(chunk) - HEAD.size).to_bytes(8, "little") + chunk[HEAD.size :]
    strange = bytearray(content[:begin] + packed + content[end : chunks[-1][1]])
    if damaged:
        strange[-5] ^= 0xFF  # the last chunk, after that of unknown compression
    whole.write_bytes(strange)
    with pytest.raises(
        RecordingError, match=f"the chunk at byte {begin} has the compression 'lz4', which this version"
    ):
        finalise(whole)
    assert whole.read_bytes() == strange


@pytest.mark.parametrize("what", ["chunk", "attachment"])
def test_nothing_that_can_be_read_is_cut_off(whole: Path, tmp_path: Path, what: str) -> None:
    [(over, _)] = records(whole, Opcode.DATA_END)
    content = bytearray(whole.read_bytes()[:over])
    attached = content[slice(*records(whole, Opcode.ATTACHMENT)[0])]
    chunks = records(whole, Opcode.CHUNK)
    index = -2 if what == "chunk" else -1
    content[chunks[index][1] - 5] ^= 0xFF
    content += attached if what == "attachment" else b""
    whole.write_bytes(content)
    assert finalise(whole)
    assert whole.read_bytes()[: len(content)] == content
    assert records(whole, Opcode.CHUNK) == chunks
    with whole.open("rb") as stream:
        summary = mcap.reader.make_reader(stream).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == len(chunks) - 1
    assert len(summary.attachment_indexes) == len(records(whole, Opcode.ATTACHMENT))


def test_a_last_chunk_of_zeros_is_not_in_the_index(whole: Path, tmp_path: Path) -> None:
    content = whole.read_bytes()
    begin, end = records(whole, Opcode.CHUNK)[-1]
    whole.write_bytes(content[: begin + 60] + bytes(end - begin - 60))
    before = expected(content, tmp_path, begin)
    assert finalise(whole)
    assert sorted(messages(whole)) == before


@pytest.mark.parametrize("what", ["garbage", "more behind the end", "no recording"])
def test_files_that_no_recorder_leaves_are_not_changed(whole: Path, what: str) -> None:
    content = whole.read_bytes()
    begin, end = records(whole, Opcode.CHUNK)[-1]
    [(over, _)] = records(whole, Opcode.DATA_END)
    strange = {
        "garbage": content[:end] + b"\x55" * 5000,
        "more behind the end": content[:over] + content[over : over + 13] + content[begin:end],
        "no recording": b"\x89MCAP0\r\n" + content[over : over + 13],
    }[what]
    whole.write_bytes(strange)
    with pytest.raises(RecordingError):
        finalise(whole)
    assert whole.read_bytes() == strange


def test_without_room_the_file_is_not_changed(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = whole.read_bytes()
    [(end, _)] = records(whole, Opcode.DATA_END)
    whole.write_bytes(content[:end])
    write = os.pwrite
    room = [10, 0]

    def pwrite(fd: int, data: bytes, at: int) -> int:
        size = room.pop(0)
        if not size:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(fd, data[:size], at)

    with monkeypatch.context() as full:
        full.setattr(os, "pwrite", pwrite)
        with pytest.raises(OSError, match="No space left"):
            finalise(whole)
    assert whole.stat().st_size <= end
    assert expected(content, whole.parent, end) == expected(whole.read_bytes(), whole.parent, end)
    assert finalise(whole)
    assert whole.read_bytes() == content


def test_a_file_in_use_is_not_changed(whole: Path) -> None:
    [(end, _)] = records(whole, Opcode.DATA_END)
    os.truncate(whole, end)
    with whole.open("rb+") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        assert not finalise(whole)
        assert whole.stat().st_size == end
    assert finalise(whole)


def test_the_successor_closes_the_file_of_a_killed_recorder(segment: Segment, tmp_path: Path) -> None:
    (tmp_path / "supervisor.toml").write_text(f'[instance]\nname = "{segment.instance}"\n')
    writer = segment.writer("cell")
    with Process(segment, tmp_path) as first:
        publish(writer, 20)
        until(lambda: first.file.is_file() and len(numbers_of(first)) == 20, "the published frames")
        kill(first.popen.pid)
        first.popen.wait()
    old = first.file
    with old.open("ab") as stream:
        stream.write(b"\x06\xff\xff")  # part of the next chunk
    with Process(segment, tmp_path) as second:
        until(lambda: closed(old), "the predecessor's file closed")
        publish(writer, 5, first=20)
        until(lambda: second.counts("frames") == 5, "its own file")
        assert second.stop() == 0
    assert [topic for topic, _, _ in messages(old)].count("cell/frames") == 20
    assert f"the recorder closed {old}, because an earlier recorder died" in second.log.read_text()
    assert numbers(old) + numbers(second.file) == list(range(1, 26))
    assert gaps(second.file) == []


def test_a_full_disk_leaves_the_file_unchanged_with_a_log_line(segment: Segment, tmp_path: Path) -> None:
    """A limit on the file's size plays the full disk. The index needs more room than the limit leaves."""
    writer = segment.writer("cell")
    with Process(segment, tmp_path) as first:
        publish(writer, 20)
        until(lambda: first.file.is_file() and len(numbers_of(first)) == 20, "the published frames")
        kill(first.popen.pid)
        first.popen.wait()
    old = first.file
    before = old.read_bytes()
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({len(before)}, resource.RLIM_INFINITY))"
    with Process(segment, tmp_path, before=limit) as second:
        until(
            lambda: (
                f"the recorder leaves {old} unchanged: " in second.log.read_text() if second.log.exists() else False
            ),
            "the log line",
        )
        second.popen.kill()
    assert f"the recorder leaves {old} unchanged: [Errno {errno.EFBIG}]" in second.log.read_text()
    assert before.startswith(old.read_bytes())
    assert numbers(old) == list(range(1, 21))


def numbers_of(process: Process) -> list[int]:
    return numbers(process.file) if process.file.stat().st_size else []


def closed(file: Path) -> bool:
    with Reader(file) as reader:
        return reader.records.footer() is not None
