"""The audit file: several processes append to it and rotate it, and no line is lost."""

from __future__ import annotations

import errno
import fcntl
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shmio.audit import file as audit_file
from shmio.audit.file import AuditFile, AuditSettings
from shmio.audit.reading import present_files

APPEND = """
import sys
from shmio.audit.file import AuditFile, AuditSettings
path, name = sys.argv[1:]
file = AuditFile(AuditSettings(path, 500, 100))
for number in range(300):
    file.append(f"{name} {number}\\n".encode())
"""


def settings(tmp_path: Path, max_bytes: int = 1000, files: int = 3) -> AuditSettings:
    return AuditSettings(str(tmp_path / "logs/audit.jsonl"), max_bytes, files)


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond ``size``, as a full disk would."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_several_processes_rotate_one_file_and_lose_no_line(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    running = [subprocess.Popen([sys.executable, "-c", APPEND, path, name]) for name in "abc"]
    assert [one.wait(60) for one in running] == [0, 0, 0]
    files = present_files(path)
    assert len(files) > 3
    assert all(file.stat().st_size <= 500 for file in files)
    lines = [line for file in files for line in file.read_text().splitlines()]
    for name in "abc":
        assert [line for line in lines if line[0] == name] == [f"{name} {number}" for number in range(300)]


def test_old_files_go_and_only_the_owner_reads_the_file(tmp_path: Path) -> None:
    file = AuditFile(settings(tmp_path))
    for number in range(100):
        file.append(b"%03d" % number + b"x" * 96 + b"\n")
    file.close()
    files = present_files(tmp_path / "logs/audit.jsonl")
    assert [one.name for one in files] == ["audit.jsonl.2", "audit.jsonl.1", "audit.jsonl"]
    text = b"".join(one.read_bytes() for one in files)
    assert [int(line[:3]) for line in text.splitlines()] == list(range(70, 100))
    assert files[-1].stat().st_mode & 0o777 == 0o600


def test_a_single_file_begins_anew(tmp_path: Path) -> None:
    file = AuditFile(settings(tmp_path, max_bytes=10, files=1))
    file.append(b"first\n")
    file.append(b"second\n")
    file.close()
    assert (tmp_path / "logs/audit.jsonl").read_bytes() == b"second\n"


def test_a_write_to_a_full_disk_leaves_no_part_of_a_line(tmp_path: Path) -> None:
    file = AuditFile(settings(tmp_path, max_bytes=10**6))
    file.append(b"before\n")
    with largest_file(100), pytest.raises(OSError, match="File too large") as full:
        file.append(b"x" * 200 + b"\n")
    assert full.value.errno == errno.EFBIG
    assert (tmp_path / "logs/audit.jsonl").read_bytes() == b"before\n"
    file.append(b"after\n")
    file.close()
    assert (tmp_path / "logs/audit.jsonl").read_bytes() == b"before\nafter\n"


def test_a_line_that_a_killed_process_left_is_ended(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/audit.jsonl").write_bytes(b'{"time": "20')
    file = AuditFile(settings(tmp_path))
    file.append(b"whole\n")
    file.close()
    assert (tmp_path / "logs/audit.jsonl").read_bytes() == b'{"time": "20\nwhole\n'


def test_a_removed_file_is_made_again(tmp_path: Path) -> None:
    file = AuditFile(settings(tmp_path))
    file.append(b"one\n")
    (tmp_path / "logs/audit.jsonl").unlink()
    file.append(b"two\n")
    file.close()
    assert (tmp_path / "logs/audit.jsonl").read_bytes() == b"two\n"


def test_a_stopped_process_with_the_lock_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_file, "LOCK_S", 0.02)
    file = AuditFile(settings(tmp_path))
    file.append(b"one\n")
    other = os.open(tmp_path / "logs/audit.jsonl", os.O_RDONLY)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(OSError, match="locked"):
            file.append(b"two\n")
    finally:
        os.close(other)
    file.append(b"three\n")
    file.close()
    assert (tmp_path / "logs/audit.jsonl").read_bytes() == b"one\nthree\n"


def test_a_link_in_place_of_the_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "elsewhere").write_bytes(b"")
    (tmp_path / "logs/audit.jsonl").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="symbolic links") as refused:
        AuditFile(settings(tmp_path)).append(b"one\n")
    assert refused.value.errno == errno.ELOOP
