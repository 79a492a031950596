"""``shmio-dump fetch``: copies a part of a cell's history to a recording."""

from __future__ import annotations

import argparse

from shmio.cli.common import dumps, say
from shmio.cli.recordings.common import fetch_history


def fetch(arguments: argparse.Namespace) -> int:
    """Write the history of a cell between two times to a new file."""
    frames = fetch_history(arguments.place, arguments, arguments.output)
    if arguments.json:
        print(dumps({"file": str(arguments.output), "frames": frames}, indent=2))
    else:
        say(f"{arguments.output}: {frames} frames")
    return 0
