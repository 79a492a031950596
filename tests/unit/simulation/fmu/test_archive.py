"""Hostile and damaged archives of FMUs, and the folders into which they are extracted."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from shmio.errors import ModelError
from shmio.simulation.fmu import archive
from shmio.simulation.fmu.archive import DESCRIPTION, Archive


def packed(folder: Path, *files: str | zipfile.ZipInfo) -> Path:
    file = folder / "x.fmu"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr(DESCRIPTION, "<x/>")
        for name in files:
            target.writestr(name, "data")
    return file


def link() -> zipfile.ZipInfo:
    info = zipfile.ZipInfo("resources/link")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("../evil", "outside the archive's folder"),
        ("resources/../../evil", "outside the archive's folder"),
        ("/etc/evil", "outside the archive's folder"),
        ("resources\\..\\evil", "outside the archive's folder"),
        (link(), "is a link"),
    ],
)
def test_files_outside_of_the_archive_and_links_are_refused(
    tmp_path: Path, name: str | zipfile.ZipInfo, message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        Archive(packed(tmp_path, name))


def test_a_fifo_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.fmu")
    with pytest.raises(ModelError, match="not a regular file"):
        Archive(tmp_path / "x.fmu")


@pytest.mark.parametrize(
    ("limit", "most", "message"),
    [
        ("MAX_FILES", 2, "it has 3 files; expected at most 2"),
        ("MAX_BYTES", 7, "have 12 bytes; expected at most 7"),
        ("MAX_DESCRIPTION_BYTES", 3, "has 4 bytes; expected at most 3"),
    ],
)
def test_large_archives_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int, message: str
) -> None:
    file = packed(tmp_path, "a", "b")
    Archive(file)
    monkeypatch.setattr(archive, limit, most)
    with pytest.raises(ModelError, match=message):
        Archive(file)


def test_a_false_size_does_not_let_more_through(tmp_path: Path) -> None:
    """The directory says 4 bytes of a file that has a million."""
    file = tmp_path / "x.fmu"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr(DESCRIPTION, " " * 1_000_000)
    data = file.read_bytes()
    size = (1_000_000).to_bytes(4, "little")
    assert data.count(size) == 2
    file.write_bytes(data.replace(size, (4).to_bytes(4, "little")))
    with pytest.raises(ModelError, match="damaged"):
        Archive(file)


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-30], lambda data: b"", lambda data: b"PK" + bytes(100), lambda data: data[40:]]
)
def test_damaged_archives_are_refused(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    file = packed(tmp_path, "a")
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(ModelError):
        Archive(file).extract()


def test_a_file_that_changed_since_it_was_read_is_not_extracted(tmp_path: Path) -> None:
    read = Archive(packed(tmp_path, "a"))
    with zipfile.ZipFile(read.path, "w") as target:
        target.writestr(DESCRIPTION, "<y/>")
    with pytest.raises(ModelError, match="was changed"):
        read.extract()


def test_the_folder_of_a_killed_process_is_removed_and_that_of_a_live_one_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    file = packed(tmp_path, "resources/a")
    program = (
        "import pathlib, sys; from shmio.simulation.fmu.archive import Archive; "
        "folder = Archive(pathlib.Path(sys.argv[1])).extract(); print(folder.path, flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, file],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as other:
        assert other.stdout is not None
        of_other = Path(other.stdout.readline().strip())
        assert (of_other / "resources/a").read_text() == "data"
        Archive(file).extract().remove()
        assert of_other.exists()
        other.send_signal(signal.SIGKILL)
        other.wait()
    own = Archive(file).extract()
    assert not of_other.exists()
    assert own.path.exists()
    own.remove()
    assert list(tmp_path.iterdir()) == [file]
