"""A page of the documentation, as its reader's shell runs it."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from shmio.testing.cell import BIN, PATIENCE_S


def environment(**more: str) -> dict[str, str]:
    """Ours, in which the commands are found; and ``more``."""
    return {**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}", **more}


def shell(commands: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Run commands in a folder, until the first that fails. ``more``: of their environment."""
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", commands],
        cwd=folder,
        env=environment(**more),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


def printed(commands: str, folder: Path, **more: str) -> str:
    """What commands print, all of which must go well."""
    done = shell(commands, folder, **more)
    assert done.returncode == 0, f"{commands}\n{done.stdout}\n{done.stderr}"
    return done.stdout
