"""``shmio-supervisor reload``: have the running instance take what has changed in its configuration."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from shmio.cli.target import ask, instance_name, open_supervised
from shmio.errors import ConfigError
from shmio.logs import printable
from shmio.supervisor import control

RELOAD_S = 90.0
WHERE_S = 5.0


def execute(arguments: argparse.Namespace) -> int:
    """Print what the supervisor did; 1 when something new does not run."""
    with open_supervised(instance_name(arguments)) as segment:
        if arguments.config is not None:
            _check_file(arguments.config, Path(ask(segment, control.Where(), WHERE_S)["config"]), segment.instance)
        answer = ask(segment, control.Reload(), RELOAD_S)
        for line in answer["warnings"]:
            print(printable(line), file=sys.stderr)
        for line in answer["done"]:
            print(printable(line))
        kept = len(answer["kept"])
        print(
            f"{segment.instance}: {kept} process{'es' * (kept != 1)} kept as {'they were' if kept != 1 else 'it was'}"
        )
        for line in answer["problems"]:
            print(printable(line), file=sys.stderr)
    return 1 if answer["problems"] else 0


def _check_file(given: Path, used: Path, instance: str) -> None:
    if given.resolve() != used:
        raise ConfigError(f"instance {instance!r} was started from {used}, which is what a reload reads; not {given}")
