"""Runs a documentation page's commands as its reader's shell does."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from shmio.testing.cell import BIN, PATIENCE_S


def environment(**more: str) -> dict[str, str]:
    """Return this process's environment, with shmio's commands on the PATH, and ``more``."""
    return {**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}", **more}


def shell(commands: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Run commands in a folder, up to the first that fails. ``more``: environment variables."""
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
    """Return what the commands print; all of them must succeed."""
    done = shell(commands, folder, **more)
    assert done.returncode == 0, f"{commands}\n{done.stdout}\n{done.stderr}"
    return done.stdout
