"""``shmio-supervisor restart NAME``: stop one process and start it again."""

from __future__ import annotations

import argparse

from shmio.cli.target import instance_name, open_supervised
from shmio.supervisor import control

RESTART_S = 40.0


def execute(arguments: argparse.Namespace) -> int:
    """Return when the process runs again."""
    with open_supervised(instance_name(arguments)) as segment:
        path = segment.header.control
    control.request(path, control.Restart(arguments.name), RESTART_S)
    print(f"{arguments.name} runs again")
    return 0
