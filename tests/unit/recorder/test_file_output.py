"""The output of a recording to a file: writes, fsync, and their failures."""

from __future__ import annotations

import os
import queue
import threading
from datetime import UTC, datetime
from pathlib import Path

import pytest

from shmio.errors import RecordingError
from shmio.recorder import file_output as module
from shmio.recorder.file_output import Output, create
from shmio.testing.cell import until

NOW = datetime(2026, 11, 21, 8, 30, 5, tzinfo=UTC)


def made(folder: Path) -> Output:
    return Output(*create(folder, "a50", NOW), limit_bytes=100)


def test_a_file_is_named_after_instance_and_time_and_never_overwritten(tmp_path: Path) -> None:
    outputs = [made(tmp_path / "new" / "dumps") for _ in range(3)]
    for number, output in enumerate(outputs):
        output.write(b"%d" % number)
        assert output.close(30)
    names = ["a50-20261121T083005Z.mem", "a50-20261121T083005Z_2.mem", "a50-20261121T083005Z_3.mem"]
    assert [output.path.name for output in outputs] == names
    assert [output.path.read_bytes() for output in outputs] == [b"0", b"1", b"2"]
    assert sorted(names) == names, "names sort by time"


def test_a_folder_where_no_file_can_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match=r"cannot create a recording in .*/file: (File exists|Not a directory)"):
        create(tmp_path / "file", "a50")


def test_pieces_are_written_whole_and_in_order(tmp_path: Path) -> None:
    output = made(tmp_path)
    for number in range(100):
        output.write(b"%02d" % number)
        if number % 7 == 0:
            output.flush()
    assert output.tell() == 200
    assert output.close(30)
    assert output.path.read_bytes() == b"".join(b"%02d" % number for number in range(100))
    assert output.written == 200


def test_it_is_full_until_half_of_the_limit_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(Output, "_put", lambda *_: False)
        output = made(tmp_path)
        output.write(bytes(101))
        full = []
        for written, more in ((0, 0), (40, 0), (51, 0), (51, 50)):  # 101, 61, 50, 100 wait
            output.written = written
            output.write(bytes(more))
            full.append(output.full)
        assert full == [True, True, False, False]
        output.written = 0
    output.close(30)


def test_a_disk_that_never_accepts_data_does_not_block_close(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(output: Output, _: bytes) -> bool:
        output.error = "Input/output error"
        return False

    monkeypatch.setattr(Output, "_put", refuse)
    output = made(tmp_path)
    output.write(b"x")
    assert not output.close(30)
    assert output.problem == f"{output.path}: Input/output error"


def test_a_failed_fsync_is_not_forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel drops data that it could not write, so a later successful fsync proves nothing."""
    calls = queue.SimpleQueue[bool]()
    done = threading.Semaphore(0)

    def fsync(_: int) -> None:
        good = calls.get(timeout=30)
        done.release()
        if not good:
            raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fsync)
    output = Output(*create(tmp_path, "a50", NOW), limit_bytes=100, fsync_s=1e-9)
    for good in (True, False, True):
        output.write(b"x" * 10)
        output.flush()
        calls.put(good)
        assert done.acquire(timeout=30)
    doubt = f"{output.path}: fsync failed (Input/output error): the data after byte 10 may be lost"
    calls.put(True)
    assert not output.close(30)
    assert (output.problem, output.written, output.synced) == (doubt, 30, 10)


@pytest.mark.parametrize("call", ["pwrite", "fsync"])
def test_a_disk_that_does_not_answer_is_reported_until_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    answered, really = threading.Event(), getattr(os, call)

    def held(*arguments: object) -> object:
        answered.wait(30)
        return really(*arguments)

    monkeypatch.setattr(os, call, held)
    monkeypatch.setattr(module, "SLOW_S", -1.0)
    output = Output(*create(tmp_path, "a50", NOW), limit_bytes=100, fsync_s=1e-9)
    output.write(b"x")
    output.flush()
    until(lambda: output.problem.startswith(f"{output.path}: the disk has not answered for "), call)
    answered.set()
    assert output.close(30)
    assert output.problem == ""
