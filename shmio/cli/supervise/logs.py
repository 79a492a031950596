"""``shmio-supervisor logs [NAME]``: the end of the log files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from shmio.cli.supervise.tail import Follower, last_lines
from shmio.cli.target import Target, ask, target
from shmio.config import load
from shmio.errors import ConfigError, SegmentError
from shmio.logs import printable
from shmio.supervisor import control
from shmio.supervisor.plan import process_names

WHERE_S = 5.0
SUPERVISOR = "supervisor"


def execute(arguments: argparse.Namespace) -> int:
    """Print the last lines, and with ``-f`` what follows until Ctrl-C."""
    folder, processes = _where(arguments)
    names = [SUPERVISOR, *processes]
    if arguments.name is not None:
        if arguments.name not in names:
            raise ConfigError(f"no process {arguments.name!r}; there are: {', '.join(names)}")
        names = [arguments.name]
    files = [folder / f"{name}.log" for name in names]
    if not any(file.exists() for file in files):
        raise ConfigError(f"no log file in {folder} yet")
    if not arguments.follow:
        _print(last_lines(files, arguments.lines))
        return 0
    with Follower(files) as follower:
        _print(last_lines(files, arguments.lines))
        while True:
            _print(follower.wait())


def _where(arguments: argparse.Namespace) -> tuple[Path, list[str]]:
    """Folder and processes: as the file says, else as the running instance does, whose file may be gone.

    What runs and is in no file, as a replay's sources may be, is known too.
    """
    wanted = target(arguments)
    if wanted.file is not None:
        config = load(wanted.file)
        return config.log_dir, list(dict.fromkeys([*process_names(config), *_running(wanted)]))
    with wanted.open_supervised() as segment:
        names = [slot.name for slot in segment.processes]
        return Path(ask(segment, control.Where(), WHERE_S)["log_dir"]), names


def _running(wanted: Target) -> list[str]:
    with suppress(SegmentError), wanted.open() as segment:
        return [slot.name for slot in segment.processes]
    return []


def _print(lines: Iterable[bytes]) -> None:
    for line in lines:
        print(printable(line.decode(errors="replace")))
    sys.stdout.flush()
