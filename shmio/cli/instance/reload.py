"""``shmio-supervisor reload``: apply changes of the configuration to the running instance."""

from __future__ import annotations

import argparse
import sys

from shmio.cli.run import dumps
from shmio.cli.target import ask, target
from shmio.logs import printable
from shmio.supervisor import control

RELOAD_S = 90.0


def execute(arguments: argparse.Namespace) -> int:
    """Print what the supervisor did; return 1 if a changed process does not run."""
    with target(arguments).open_supervised() as segment:
        answer = ask(segment, control.Reload(), RELOAD_S)
        if arguments.json:
            told = {key: answer[key] for key in ("done", "kept", "warnings", "problems")}
            print(dumps({"instance": segment.instance, **told}, indent=2))
            return 1 if answer["problems"] else 0
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
