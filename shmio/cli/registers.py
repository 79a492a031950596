"""``shmio list``: which registers there are."""

from __future__ import annotations

import argparse

from shmio.cli.readings import choose, topic_path
from shmio.cli.run import dumps
from shmio.layout.model import Register
from shmio.logs import printable
from shmio.segment.attach import Attachment

HELP = "List registers with their types."


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="*", metavar="PATH", help="path, structure or glob (default: everything)")


def execute(cell: Attachment, options: argparse.Namespace) -> int:
    """Print a line for each register, or one JSON list."""
    found = choose(cell, options.patterns or cell.sources)
    if options.json:
        print(
            dumps(
                [
                    {
                        "path": topic_path(block, r),
                        "type": r.type,
                        "dims": [list(d) for d in r.dims] or None,
                        "comment": r.comment,
                    }
                    for block, r in found
                ]
            )
        )
        return 0
    width = max((len(topic_path(*item)) for item in found), default=0)
    for block, register in found:
        comment = f"  {register.comment}" if register.comment else ""
        print(printable(f"{topic_path(block, register):<{width}}  {_type(register)}{comment}".rstrip()))
    return 0


def _type(register: Register) -> str:
    bounds = ", ".join(f"{low}..{high}" for low, high in register.dims)
    return f"ARRAY[{bounds}] OF {register.type}" if bounds else register.type
