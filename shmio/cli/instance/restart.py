"""``shmio-supervisor restart NAME``: stop one process and start it again."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path

from shmio.cli.target import ask, target
from shmio.supervisor import control

RESTART_S = 40.0
WHERE_S = 5.0


def execute(arguments: argparse.Namespace) -> int:
    """Restart a process; return when it runs again."""
    with target(arguments).open_supervised() as segment:
        ask(segment, control.Restart(arguments.name), RESTART_S)
        print(f"{arguments.name} runs again")
        where = ask(segment, control.Where(), WHERE_S)
        file = Path(where["config"])
        if _changed(file, where["read_ns"]):
            print(f"{file} has changed since it was read; restart keeps the old configuration, reload takes the new")
    return 0


def _changed(file: Path, read_ns: int) -> bool:
    with suppress(OSError):
        return file.stat().st_mtime_ns > read_ns
    return False
