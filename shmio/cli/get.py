"""``shmio get``: print present values."""

from __future__ import annotations

import argparse

from shmio.cli.readings import as_json, as_line
from shmio.cli.run import add_full, dumps, room
from shmio.model.cell import Cell

HELP = "Print the present values of registers, with quality and age."


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="+", metavar="PATH", help="path, array element, structure or glob")
    add_full(parser)


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Print all values of one source from one frame."""
    found = cell.get(*options.patterns)
    if options.json:
        print(dumps({one.path: as_json(one) for one in found}))
        return 0
    width = max(len(one.path) for one in found)
    for one in found:
        print(as_line(one, width, room(options)))
    return 0
