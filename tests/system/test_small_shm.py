"""A shared-memory file system that is too small, as containers have by default."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from shmio.testing.cell import BIN, Cell

SCRIPT = """
set -e
mount -t tmpfs -o size={size} tmpfs /dev/shm
cd {folder}
{commands}
"""


def in_small_shm(folder: Path, size: str, commands: str) -> subprocess.CompletedProcess[str]:
    script = SCRIPT.format(size=size, folder=folder, commands=commands)
    return subprocess.run(
        ["unshare", "--mount", "--propagation", "private", "sh", "-c", script],
        capture_output=True,
        text=True,
        check=False,
        timeout=110,
        env={**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}"},
    )


@pytest.fixture
def stopped_cell(make_cell: object, tmp_path: Path) -> Cell:
    if os.geteuid() != 0:
        pytest.skip("only root can mount a file system")
    if in_small_shm(tmp_path, "1m", "true").returncode:
        pytest.skip("no mount name spaces here")
    assert callable(make_cell)
    cell = make_cell()
    assert isinstance(cell, Cell)
    return cell


def test_a_start_without_room_names_the_needed_size_and_the_remedy(stopped_cell: Cell) -> None:
    done = in_small_shm(stopped_cell.folder, "1m", "shmio-supervisor up")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "/dev/shm has no room for the segment" in line
    assert "MB needed, " in line
    assert "docker: --shm-size" in line


def test_a_reload_without_room_changes_nothing(stopped_cell: Cell) -> None:
    file = stopped_cell.folder / "supervisor.toml"
    source, rest = file.read_text().split("[[emulator]]")
    more = "".join(
        "[[source]]" + source.split("[[source]]")[1].replace('"cell"', f'"more{i}"').replace("= 20", "= 1")
        for i in range(3)
    )
    (stopped_cell.folder / "larger.toml").write_text(f"{source}{more}[[emulator]]{rest}")
    done = in_small_shm(
        stopped_cell.folder,
        "12m",
        "shmio-supervisor up --detach >/dev/null; cp larger.toml supervisor.toml; "
        "shmio-supervisor reload && refused=no || refused=yes; "
        "shmio-supervisor status; shmio-supervisor down; test $refused = yes",
    )
    assert done.returncode == 0, done.stderr
    assert "/dev/shm has no room for the segment" in done.stderr
    assert "more0" not in done.stdout
