"""Files of snapshots: damaged, of other versions, killed writers, full disks."""

from __future__ import annotations

import errno
import hashlib
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shmio.errors import SnapshotError
from shmio.local import snapshot_file
from shmio.local.snapshot_file import (
    SnapshotHead,
    delete_snapshot,
    file_of,
    list_snapshots,
    read_snapshot,
    work_folder,
    write_snapshot,
)

HEAD = SnapshotHead("line", 1.5, 7, 7, 140_000_000, 20_000_000, {"belt": "ab"}, {"plc": "it goes on"})
STATES = {"belt": b"\x01" * 100, "panel": b""}


def write(folder: Path, states: dict[str, bytes] = STATES, name: str = "warm") -> Path:
    file = file_of(folder, name)
    with work_folder(folder) as work:
        write_snapshot(file, work, HEAD, states)
    return file


def test_a_snapshot_is_read_as_it_was_written(tmp_path: Path) -> None:
    file = write(tmp_path / "new" / "folder")
    info, head, states = read_snapshot(file)
    assert (head, states) == (HEAD, STATES)
    assert (info.name, info.step, info.left_out, info.size_bytes) == ("warm", 7, HEAD.left_out, file.stat().st_size)
    assert list_snapshots(file.parent) == [info]
    assert [one.name for one in file.parent.iterdir()] == ["warm.snapshot"]
    assert (file.stat().st_mode & 0o777, file.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    delete_snapshot(file)
    with pytest.raises(SnapshotError, match=r"unknown snapshot 'warm'.*none"):
        read_snapshot(file)


def test_a_text_that_is_not_utf_8_makes_it_invalid(tmp_path: Path) -> None:
    """Its checksum is right, as anybody can compute it."""
    file = write(tmp_path)
    good = file.read_bytes()
    at = good.index(b"{") + 2
    damaged = good[:at] + b"\xff" + good[at + 1 :]
    begin = at - 2
    assert good[begin - 32 : begin] == hashlib.sha256(good[begin:]).digest()
    file.write_bytes(damaged[: begin - 32] + hashlib.sha256(damaged[begin:]).digest() + damaged[begin:])
    with pytest.raises(SnapshotError, match="invalid"):
        read_snapshot(file)
    (listed,) = list_snapshots(tmp_path)
    assert "invalid" in listed.problem


def test_each_damaged_byte_is_noticed(tmp_path: Path) -> None:
    file = write(tmp_path)
    good = file.read_bytes()
    for place in range(len(good)):
        file.write_bytes(good[:place] + bytes([good[place] ^ 0x40]) + good[place + 1 :])
        with pytest.raises(SnapshotError, match=r"damaged|not a snapshot|version"):
            read_snapshot(file)
        list_snapshots(tmp_path)
    for size in (0, 10, 60, len(good) - 1):
        file.write_bytes(good[:size])
        with pytest.raises(SnapshotError, match=r"damaged|not a snapshot"):
            read_snapshot(file)
        assert list_snapshots(tmp_path)[0].problem
    file.write_bytes(good + b"x")
    with pytest.raises(SnapshotError, match="damaged"):
        read_snapshot(file)
    assert list_snapshots(tmp_path)[0].problem


def test_a_list_checks_the_checksums_of_the_newest_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, name in enumerate(("old", "new")):
        file = write(tmp_path, name=name)
        content = file.read_bytes()
        file.write_bytes(content[:-60] + b"\xff" + content[-59:])  # in a state
        os.utime(file, (number, number))
    damaged = [one.problem for one in list_snapshots(tmp_path)]
    assert damaged == [f"{tmp_path / name}.snapshot is damaged: its checksum is wrong" for name in ("new", "old")]
    monkeypatch.setattr(snapshot_file, "MAX_SUMMED_BYTES", len(content))
    assert [(one.name, bool(one.problem)) for one in list_snapshots(tmp_path)] == [("new", True), ("old", False)]


def test_a_valid_checksum_does_not_make_the_content_valid(tmp_path: Path) -> None:
    for head, body in ((b"{}", b"\x80"), (b"[" * 9999, b"\x80"), (b'{"instance":1}', b"\x80"), (None, b"\xc0")):
        data = msgspec.json.encode(HEAD) if head is None else head
        digest = hashlib.sha256(data + body).digest()
        file = tmp_path / "odd.snapshot"
        file.write_bytes(snapshot_file._HEADER.pack(b"SHMIOSNP", 1, len(data), len(body), digest) + data + body)
        with pytest.raises(SnapshotError, match="invalid"):
            read_snapshot(file)


def test_a_writer_that_fails_leaves_the_old_snapshot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write(tmp_path)

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(SnapshotError, match=r"warm.snapshot: No space left.*not saved"):
            write(tmp_path, {"belt": b"new"})
    assert read_snapshot(file)[2] == STATES
    assert [one.name for one in tmp_path.iterdir()] == ["warm.snapshot"]


KILLED = """
import os, sys
from pathlib import Path
from tests.unit.local.test_snapshot_file import *
folder, turn = Path(sys.argv[1]), int(sys.argv[2])
count = 0
def dies(call):
    def wrapped(*arguments, **keywords):
        global count
        count += 1
        if count == turn:
            os.kill(os.getpid(), 9)
        return call(*arguments, **keywords)
    return wrapped
os.fsync, Path.rename, os.fdopen = dies(os.fsync), dies(Path.rename), dies(os.fdopen)
write(folder, {"belt": b"new" * 1000})
"""


def test_a_killed_writer_leaves_the_old_or_the_new_snapshot(tmp_path: Path) -> None:
    file = write(tmp_path)
    seen: set[Any] = set()
    for turn in range(1, 6):
        done = subprocess.run([sys.executable, "-c", KILLED, tmp_path, str(turn)], check=False)
        seen.add(done.returncode)
        _, _, states = read_snapshot(file)
        assert states in (STATES, {"belt": b"new" * 1000})
        if states != STATES:
            write(tmp_path)
    assert seen == {0, -9}
    with work_folder(tmp_path):
        pass
    assert [one.name for one in tmp_path.iterdir()] == ["warm.snapshot"], "what killed writers left is removed"


def test_the_folder_of_another_writer_stays(tmp_path: Path) -> None:
    with work_folder(tmp_path) as mine, work_folder(tmp_path):
        assert mine.exists()


def test_a_folder_that_is_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SnapshotError, match="file"), work_folder(tmp_path / "file"):
        pass
    with suppress(SnapshotError):
        list_snapshots(tmp_path / "file")
    assert list_snapshots(tmp_path / "none") == []


def test_a_list_has_the_newest_and_does_not_wait_for_a_fifo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for age, name in enumerate(("c", "b", "a")):
        os.utime(write(tmp_path, name=name), (age, age))
    monkeypatch.setattr(snapshot_file, "MAX_LISTED", 2)
    assert [one.name for one in list_snapshots(tmp_path)] == ["a", "b"]
    os.mkfifo(tmp_path / "pipe.snapshot")
    (found,) = [one for one in list_snapshots(tmp_path) if one.name == "pipe"]
    assert found.problem == f"{tmp_path / 'pipe.snapshot'}: not a regular file"
    with pytest.raises(SnapshotError, match="not a regular file"):
        read_snapshot(tmp_path / "pipe.snapshot")


def test_a_new_folder_without_a_snapshot_is_removed(tmp_path: Path) -> None:
    with work_folder(tmp_path / "new") as work:
        assert work.exists()
    assert not list(tmp_path.iterdir())
