"""``shmio get``: print present values."""

from __future__ import annotations

import argparse

from shmio.cli.cell import Cell
from shmio.cli.readings import as_json, as_line, choose
from shmio.cli.run import add_full, dumps, room

HELP = "Print the present values of registers, with quality and age."


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="+", metavar="PATH", help="path, array element, structure or glob")
    add_full(parser)


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Print all values of one source from one frame."""
    chosen = choose(cell, options.patterns)
    found = list(zip(chosen, cell.readings(options.patterns, chosen), strict=True))
    if options.json:
        print(dumps({what.path: as_json(now, what.register) for what, now in found}))
        return 0
    width = max(len(what.path) for what in chosen)
    for what, now in found:
        print(as_line(what.path, now, what.register, width, room(options)))
    return 0
