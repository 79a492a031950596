"""``shmio watch``: values as they change."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime

from shmio.cli.cell import Cell
from shmio.cli.readings import as_json, as_line
from shmio.cli.run import at_least, dumps
from shmio.segment import Quality
from shmio.segment.view import Reading

HELP = "Print the values of registers whenever they change, the present ones first."


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="+", metavar="PATH", help="path, array element, structure or glob")
    parser.add_argument("-n", dest="count", type=at_least(1), metavar="N", help="stop after N lines")


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Print a line for each change until interrupted, or until the instance ends."""
    for printed, (what, now, width) in enumerate(cell.news(options.patterns), 1):
        if options.json:
            print(dumps({"path": what.path, **as_json(now, what.register)}), flush=True)
        else:
            print(f"{_clock(now)}  {as_line(what.path, now, what.register, width)}", flush=True)
        if options.count is not None and printed >= options.count:
            break
    return 0


def _clock(now: Reading) -> str:
    """The value's own time; of one that is bad, when that was noticed."""
    if now.quality is Quality.BAD:
        return datetime.now(UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
    if now.source_time is None:
        return "-" * 12
    return datetime.fromtimestamp(now.source_time, UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
