"""``shmio list``, ``shmio get`` and ``shmio watch``: print registers and their values."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

from shmio import garbage
from shmio.cli.common import add_full, at_least, draw, dumps, room, seconds
from shmio.errors import NotRunningError, PathError
from shmio.layout.glob import choose
from shmio.layout.model import Register
from shmio.layout.values.codec import Value
from shmio.layout.values.literal import literal_text
from shmio.layout.values.text import json_value
from shmio.model.cell import Cell
from shmio.model.values import Provenance, Quality, Reading
from shmio.times import local_text, utc_text
from shmio.wording import printable

TABLE_EVERY_S = 0.2
CLOCK_CHARACTERS = 12
CUT = "… (all: --full)"


def list_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``list``."""
    parser.add_argument("patterns", nargs="*", metavar="PATH", help="path, structure or glob (default: everything)")


def list_registers(cell: Cell, options: argparse.Namespace) -> int:
    """Print a line for each register, or all registers as one JSON list."""
    with garbage.paused():
        _list(cell, options)
    return 0


def _list(cell: Cell, options: argparse.Namespace) -> None:
    layouts = cell.layouts()
    found = [(f"{source}/{one.path}", one) for source, one in choose(options.patterns or layouts, layouts)]
    if options.json:
        print(dumps([_described(path, one) for path, one in found]))
        return
    width = 2 + max((len(path) for path, _ in found), default=0)
    lines = [
        path.ljust(width) + (_array_type(one) if one.dims else one.type) + (one.comment and f"  {one.comment}".rstrip())
        for path, one in found
    ]
    if not "".join(lines).isprintable():
        lines = [printable(line) for line in lines]
    if lines:
        print("\n".join(lines))  # printing each line takes longer than making it


def _described(path: str, register: Register) -> dict[str, Any]:
    dims = [list(bounds) for bounds in register.dims] or None
    return {"path": path, "type": register.type, "dims": dims, "comment": register.comment}


def _array_type(register: Register) -> str:
    """Return the type of an array, with its bounds."""
    bounds = ", ".join(f"{low}..{high}" for low, high in register.dims)
    return f"ARRAY[{bounds}] OF {register.type}"


def get_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``get``."""
    parser.add_argument("patterns", nargs="+", metavar="PATH", help="path, array element, structure or glob")
    add_full(parser)


def get(cell: Cell, options: argparse.Namespace) -> int:
    """Print the present values. All values of a source are from the same frame."""
    found = cell.get(*options.patterns)
    if options.json:
        print(dumps({one.path: object_of(one) for one in found}))
        return 0
    width = _width(found)
    for one in found:
        print(line_of(one, width, room(options)))
    return 0


def watch_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``watch``."""
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


def watch(cell: Cell, options: argparse.Namespace) -> int:
    """Print values until Ctrl-C, the end of the instance, or the given number of lines."""
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
            if options.json:
                line = dumps({"path": one.path, **object_of(one)})
            else:
                line = f"{clock(one)}  {line_of(one, width, room(options))}"
            print(line, flush=True)
            printed += 1
            if printed == options.count:
                return 0
    return 0


def _table(cell: Cell, options: argparse.Namespace) -> int:
    """Show a line for each register, and update the lines in place."""
    drawn = 0
    for read in _rounds(cell, options.patterns, options.every_s or TABLE_EVERY_S):
        columns = shutil.get_terminal_size().columns
        width, limit = _width(read), room(options)
        if limit is not None:
            limit = min(limit, columns - CLOCK_CHARACTERS - width - 4)
        lines = [f"{clock(one)}  {line_of(one, width, limit)}" for one in read]
        if options.full:
            lines = [line[at : at + columns] for line in lines for at in range(0, len(line), columns)]
        drawn = draw(lines, drawn, "; enlarge the window, or use --lines")
    return 0


def _changes(cell: Cell, patterns: Sequence[str], *, every_frame: bool) -> Iterator[Sequence[Reading]]:
    """Yield the present readings of all registers that match the patterns, then changed readings.

    Raises:
        NotRunningError: The instance has ended, or a reload has removed a source or a register.

    """
    batch: Sequence[Reading] = cell.get(*patterns)
    last: dict[str, tuple[object, ...]] = {}
    with cell.subscribe(*patterns, every_frame=every_frame) as updates:
        while True:
            # The reason of a stale value contains its age: that part is ignored. repr makes NaNs equal.
            now = {one.path: (repr(one.value), one.quality, one.reason.partition(":")[0]) for one in batch}
            yield [one for one in batch if last.get(one.path) != now[one.path]]
            last |= now
            update = next(updates)
            if update.ended:
                removed = "" if update.reason.endswith("by a reload") else ": a reload removed it"
                raise NotRunningError(f"{update.reason}{removed}")
            batch = update.readings


def _rounds(cell: Cell, patterns: Sequence[str], every_s: float) -> Iterator[Sequence[Reading]]:
    """Yield the readings of all registers that match the patterns, every ``every_s`` s from now on.

    Raises:
        PathError: A pattern matches nothing.
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


def clock(reading: Reading) -> str:
    """Return the time of a value as text; the present time if the value is bad."""
    if reading.quality is Quality.BAD:
        when_s = time.time()
    elif reading.source_time is None:
        return "-" * CLOCK_CHARACTERS
    else:
        when_s = reading.source_time
    return local_text(when_s).partition(" ")[2]


def object_of(reading: Reading) -> dict[str, Any]:
    """Return a reading as the object that ``get --json`` and ``watch --json`` print."""
    return {
        "value": json_value(reading.value, reading.register.element),
        "quality": str(reading.quality),
        "reason": reading.reason,
        "provenance": reading.provenance,
        "source_time": reading.source_time and utc_text(reading.source_time),
        "age_s": reading.age_s,
    }


def line_of(reading: Reading, width: int, limit: int | None) -> str:
    """Return a reading as a line of text.

    The line has the quality if it is not good, and says whether the value is injected.
    """
    quality = "" if reading.quality is Quality.GOOD else f"  {reading.quality}: {printable(reading.reason)}"
    injected = f"  ({reading.provenance})" if reading.provenance == str(Provenance.INJECTED) else ""
    value = shown(reading.value, reading.register, limit)
    return f"{printable(reading.path):<{width}}  {value}{injected}{quality}"


def shown(value: Value, register: Register, limit: int | None) -> str:
    """Return a value as text; ``-`` if there is no value, ``""`` for an empty text.

    ``limit`` is the maximum number of characters; None for no limit. A longer text is cut, and ends
    with a hint how to see all of it.
    """
    text = "-" if value is None else printable(literal_text(value, register)) or '""'
    return text if limit is None or len(text) <= limit else f"{text[: max(limit - len(CUT), 0)]}{CUT}"
