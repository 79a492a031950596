"""``shmio-supervisor logs [NAME]``: the end of the log files."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from shmio.cli.run import dumps
from shmio.cli.supervise.tail import Follower, last_lines
from shmio.cli.target import Target, ask, target
from shmio.config import load
from shmio.errors import ConfigError, SegmentError
from shmio.logs import printable
from shmio.supervisor import control
from shmio.supervisor.plan import process_names

WHERE_S = 5.0
SUPERVISOR = "supervisor"

_LINE = re.compile(
    r"(?P<time>[0-9T:.-]+Z) (?P<level>[A-Z]+) +(?P<process>.+?)\[(?P<pid>[0-9]{1,10})\] (?P<text>.*)", re.DOTALL
)
"""As shmio.logs writes it."""


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
        _print(last_lines(files, arguments.lines), as_json=arguments.json)
        return 0
    with Follower(files) as follower:
        _print(last_lines(files, arguments.lines), as_json=arguments.json)
        while True:
            _print(follower.wait(), as_json=arguments.json)


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


def _print(lines: Iterable[bytes], *, as_json: bool) -> None:
    for line in lines:
        text = line.decode(errors="replace")
        print(dumps(_parsed(text)) if as_json else printable(text))
    sys.stdout.flush()


def _parsed(line: str) -> dict[str, Any]:
    """A line's parts; all but its text are None where it goes on with the one before, as those of a traceback."""
    found = _LINE.fullmatch(line)
    if found is None:
        return {"time": None, "level": None, "process": None, "pid": None, "text": line}
    return {**found.groupdict(), "pid": int(found["pid"])}
