"""``shmio list``: list registers."""

from __future__ import annotations

import argparse

from shmio.cli.cell import Cell
from shmio.cli.readings import choose
from shmio.cli.run import dumps
from shmio.layout.model import Register
from shmio.logs import printable

HELP = "List registers with their types."


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="*", metavar="PATH", help="path, structure or glob (default: everything)")


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Print a line for each register, or one JSON list."""
    found = choose(cell, options.patterns or cell.sources)
    if options.json:
        print(
            dumps(
                [
                    {
                        "path": one.path,
                        "type": one.register.type,
                        "dims": [list(d) for d in one.register.dims] or None,
                        "comment": one.register.comment,
                    }
                    for one in found
                ]
            )
        )
        return 0
    width = max((len(one.path) for one in found), default=0)
    for one in found:
        comment = f"  {one.register.comment}" if one.register.comment else ""
        print(printable(f"{one.path:<{width}}  {_type(one.register)}{comment}".rstrip()))
    return 0


def _type(register: Register) -> str:
    bounds = ", ".join(f"{low}..{high}" for low, high in register.dims)
    return f"ARRAY[{bounds}] OF {register.type}" if bounds else register.type
