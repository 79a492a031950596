"""``shmio watch``: print values as they change, or at intervals."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

from shmio.cli.readings import as_json, as_line
from shmio.cli.run import add_full, at_least, dumps, room, seconds
from shmio.errors import NotRunningError, PathError
from shmio.model.cell import Cell
from shmio.model.reading import Reading
from shmio.model.values import Quality

HELP = "Print registers whenever they change, the present values first; on a terminal, as a table."

TABLE_EVERY_S = 0.2
CLOCK_CHARACTERS = 12


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="+", metavar="PATH", help="path, array element, structure or glob")
    parser.add_argument(
        "--every",
        dest="every_s",
        type=seconds,
        metavar="SECONDS",
        help="print all of them at this interval, changed or not",
    )
    parser.add_argument(
        "--lines", action="store_true", help="print a line for each change instead of a table on a terminal"
    )
    parser.add_argument("-n", dest="count", type=at_least(1), metavar="N", help="stop after N lines")
    add_full(parser)


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Print until interrupted, until the instance ends, or up to the number of lines."""
    lines = options.json or options.lines or options.count is not None
    if not lines and sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb":
        return _table(cell, options)
    if options.every_s is None:
        batches = _changes(cell, options.patterns, every_frame=options.host is None)
    else:
        batches = _rounds(cell, options.patterns, options.every_s)
    width = printed = 0
    for batch in batches:
        width = max(width, _width(batch))
        for one in batch:
            print(_object(one) if options.json else _line(one, width, room(options)), flush=True)
            printed += 1
            if printed == options.count:
                return 0
    return 0


def _table(cell: Cell, options: argparse.Namespace) -> int:
    """Show a line for each register, updated in place."""
    drawn = 0
    for read in _rounds(cell, options.patterns, options.every_s or TABLE_EVERY_S):
        columns, rows = shutil.get_terminal_size()
        width, limit = _width(read), room(options)
        if limit is not None:
            limit = min(limit, columns - CLOCK_CHARACTERS - width - 4)
        lines = [_line(one, width, limit) for one in read]
        if options.full:
            lines = [line[at : at + columns] for line in lines for at in range(0, len(line), columns)]
        if len(lines) >= rows:
            more = f"… and {len(lines) - rows + 2} more lines: enlarge the window, or use --lines"
            lines = [*lines[: max(rows - 2, 0)], more]
        up = f"\x1b[{drawn}F" if drawn else ""
        text = "".join(f"{line}\x1b[K\n" for line in lines)
        sys.stdout.write(f"{up}\x1b[?7l{text}\x1b[J\x1b[?7h")  # the terminal cuts lines that are too long
        sys.stdout.flush()
        drawn = len(lines)
    return 0


def _changes(cell: Cell, patterns: Sequence[str], *, every_frame: bool) -> Iterator[Sequence[Reading]]:
    """Yield the present readings of all that the patterns name, then those that have changed.

    NotRunningError: The instance has ended, or a reload has removed a source or a register.
    """
    batch: Sequence[Reading] = cell.get(*patterns)
    shown: dict[str, tuple[object, ...]] = {}
    with cell.subscribe(*patterns, every_frame=every_frame) as updates:
        while True:
            # A stale reason holds the age: its text changes, the fact does not. repr: a NaN equals itself.
            now = {one.path: (repr(one.value), one.quality, one.reason.partition(":")[0]) for one in batch}
            yield [one for one in batch if shown.get(one.path) != now[one.path]]
            shown |= now
            update = next(updates)
            if update.ended:
                removed = "" if update.reason.endswith("by a reload") else ": a reload removed it"
                raise NotRunningError(f"{update.reason}{removed}")
            batch = update.readings


def _rounds(cell: Cell, patterns: Sequence[str], every_s: float) -> Iterator[Sequence[Reading]]:
    """Yield all that the patterns name, at once and then every ``every_s`` seconds.

    Raises:
        PathError: A pattern names nothing.
        NotRunningError: The instance has stopped, or a reload has removed the registers.

    """
    due_s = time.monotonic()
    readings = cell.get(*patterns)
    while True:
        yield readings
        due_s = max(due_s + every_s, time.monotonic())
        time.sleep(max(due_s - time.monotonic(), 0))
        try:
            readings = cell.get(*patterns)
        except PathError as error:
            raise NotRunningError(f"{error}: a reload removed it") from None


def _width(readings: Sequence[Reading]) -> int:
    """Return the length of the longest path."""
    return max((len(one.path) for one in readings), default=0)


def _object(reading: Reading) -> str:
    return dumps({"path": reading.path, **as_json(reading)})


def _line(reading: Reading, width: int, limit: int | None) -> str:
    return f"{_clock(reading)}  {as_line(reading, width, limit)}"


def _clock(now: Reading) -> str:
    """Return the time of a value; for a bad value, the present time."""
    if now.quality is Quality.BAD:
        return datetime.now(UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
    if now.source_time is None:
        return "-" * CLOCK_CHARACTERS
    return datetime.fromtimestamp(now.source_time, UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
