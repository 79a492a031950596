"""``shmio-supervisor logs [NAME]``: prints the end of the log files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from shmio import control
from shmio.cli.common import dumps
from shmio.cli.target import Target, target
from shmio.config import load
from shmio.errors import ConfigError, SegmentError
from shmio.local.log_files import Follower, as_text, last_lines, parse_line
from shmio.local.supervisor import ask_supervisor
from shmio.plan.processes import process_names
from shmio.wording import printable, unknown

WHERE_S = 5.0
SUPERVISOR = "supervisor"


def logs(arguments: argparse.Namespace) -> int:
    """Print the last lines of the logs; with ``-f``, also new lines until Ctrl-C."""
    folder, processes = _where(arguments)
    names = [SUPERVISOR, *processes]
    if arguments.name is not None:
        if arguments.name not in names:
            raise ConfigError(unknown("process", arguments.name, names))
        names = [arguments.name]
    files = [folder / f"{name}.log" for name in names]
    if not any(file.exists() for file in files):
        raise ConfigError(f"{folder} has no log files yet")
    if not arguments.follow:
        _print(last_lines(files, arguments.lines), as_json=arguments.json)
        return 0
    with Follower(files) as follower:
        _print(last_lines(files, arguments.lines), as_json=arguments.json)
        while True:
            _print(follower.wait(), as_json=arguments.json)


def _where(arguments: argparse.Namespace) -> tuple[Path, list[str]]:
    """Return the log folder and the names of the processes.

    They come from the configuration. If it cannot be read, they come from the running instance.
    Running processes that are not in the file, such as the sources of a replay, are included.
    """
    wanted = target(arguments)
    if wanted.file is not None:
        config = load(wanted.file)
        return config.log_dir, list(dict.fromkeys([*process_names(config), *_running(wanted)]))
    with wanted.open_supervised() as segment:
        names = [slot.name for slot in segment.processes]
        return Path(ask_supervisor(segment, control.Where(), WHERE_S)["log_dir"]), names


def _running(wanted: Target) -> list[str]:
    with suppress(SegmentError), wanted.open() as segment:
        return [slot.name for slot in segment.processes]
    return []


def _print(lines: Iterable[bytes], *, as_json: bool) -> None:
    for line in lines:
        text = line.decode(errors="replace")
        if as_json:
            print(dumps(parse_line(text)))
        else:
            print(*map(printable, as_text(text).split("\n")), sep="\n")
    sys.stdout.flush()
