"""``shmio-supervisor logs [NAME]``: the end of the log files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path

from shmio.cli.supervise.tail import Follower, last_lines
from shmio.cli.target import DEFAULT_CONFIG, config_file, instance_name, open_supervised
from shmio.config import Config, load
from shmio.errors import ConfigError
from shmio.logs import printable
from shmio.supervisor import control

WHERE_S = 5.0
SUPERVISOR = "supervisor"


def execute(arguments: argparse.Namespace) -> int:
    """Print the last lines, and with ``-f`` what follows until Ctrl-C."""
    config = _config(arguments)
    names = [SUPERVISOR, *(emulator.name for emulator in config.emulator), *(source.name for source in config.source)]
    names += ["grpc"] if config.grpc else []
    if arguments.name is not None:
        if arguments.name not in names:
            raise ConfigError(f"no process {arguments.name!r}; there are: {', '.join(names)}")
        names = [arguments.name]
    files = [config.log_dir / f"{name}.log" for name in names]
    if not any(file.exists() for file in files):
        raise ConfigError(f"no log file in {config.log_dir} yet")
    if not arguments.follow:
        _print(last_lines(files, arguments.lines))
        return 0
    try:
        with Follower(files) as follower:
            _print(last_lines(files, arguments.lines))
            while True:
                _print(follower.wait())
    except KeyboardInterrupt:
        return 0


def _config(arguments: argparse.Namespace) -> Config:
    """The configuration: the file's, or the one that the running instance was started from."""
    if arguments.instance is None and (arguments.config is not None or DEFAULT_CONFIG.exists()):
        return load(config_file(arguments))
    with open_supervised(instance_name(arguments)) as segment:
        path = segment.header.control
    return load(Path(control.request(path, control.Where(), WHERE_S)["config"]))


def _print(lines: Iterable[bytes]) -> None:
    for line in lines:
        print(printable(line.decode(errors="replace")))
    sys.stdout.flush()
