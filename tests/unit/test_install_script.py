"""``scripts/install`` says what it does before it takes long."""

from __future__ import annotations

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]
PYTHON = """#!/bin/sh
[ "$1" != -m ] || { echo "python $*" >&2; exit 1; }
"""


def test_the_first_line_comes_before_the_environment_is_made(tmp_path: Path) -> None:
    (tmp_path / "scripts").mkdir()
    for name in ("scripts/install", "pyproject.toml", "setup.py", "shmio"):
        (tmp_path / name).symlink_to(ROOT / name)
    python = tmp_path / "python"
    python.write_text(PYTHON)
    python.chmod(0o755)
    done = subprocess.run(
        [tmp_path / "scripts/install", "web"],
        env={"PATH": "/usr/bin:/bin", "PYTHON": str(python), "CC": "true"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    first, second, third = done.stderr.splitlines()
    assert first.startswith("installing shmio with web into .venv: ")
    assert second == "python -m venv .venv"
    assert third.startswith("cannot create .venv")
    assert done.returncode == 1
