"""``shmio list``: list registers."""

from __future__ import annotations

import argparse

from shmio.cli.run import dumps
from shmio.layout.glob import choose
from shmio.layout.model import Register
from shmio.logs import printable
from shmio.model.cell import Cell

HELP = "List registers with their types."


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="*", metavar="PATH", help="path, structure or glob (default: everything)")


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Print a line for each register, or one JSON list."""
    layouts = cell.layouts()
    found = [(f"{source}/{one.path}", one) for source, one in choose(options.patterns or layouts, layouts)]
    if options.json:
        print(
            dumps(
                [
                    {
                        "path": path,
                        "type": one.type,
                        "dims": [list(d) for d in one.dims] or None,
                        "comment": one.comment,
                    }
                    for path, one in found
                ]
            )
        )
        return 0
    width = max((len(path) for path, _ in found), default=0)
    for path, one in found:
        comment = f"  {one.comment}" if one.comment else ""
        print(printable(f"{path:<{width}}  {_type(one)}{comment}".rstrip()))
    return 0


def _type(register: Register) -> str:
    bounds = ", ".join(f"{low}..{high}" for low, high in register.dims)
    return f"ARRAY[{bounds}] OF {register.type}" if bounds else register.type
