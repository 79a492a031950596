"""``shmio watch``: values as they change."""

from __future__ import annotations

import argparse
import queue
import threading
from collections.abc import Iterator
from datetime import UTC, datetime

from shmio.cli.readings import Selected, as_json, as_line, choose, topic_path
from shmio.cli.run import at_least, dumps
from shmio.errors import NotRunningError, PathError
from shmio.layout.model import Register
from shmio.segment import Block, Frame, Quality
from shmio.segment.attach import Attachment
from shmio.segment.view import Reading, reading

HELP = "Print the values of registers whenever they change, the present ones first."
IDLE_S = 0.5
WAITING_FRAMES = 64
"""Changes of so many frames may wait for a slow terminal; a block further behind goes on with its newest frame."""

News = tuple[Block, Register, Reading]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb's own arguments."""
    parser.add_argument("patterns", nargs="+", metavar="PATH", help="path, array element, structure or glob")
    parser.add_argument("-n", dest="count", type=at_least(1), metavar="N", help="stop after N lines")


def execute(cell: Attachment, options: argparse.Namespace) -> int:
    """Print a line for each change until interrupted, or until the instance ends."""
    for printed, (block, register, now, width) in enumerate(_news(cell, options.patterns), 1):
        path = topic_path(block, register)
        if options.json:
            print(dumps({"path": path, **as_json(now, register)}), flush=True)
        else:
            print(f"{_clock(now)}  {as_line(path, now, register, width)}", flush=True)
        if options.count is not None and printed >= options.count:
            return 0
    raise NotRunningError(f"instance {cell.instance!r} has stopped")


def _news(cell: Attachment, patterns: list[str]) -> Iterator[tuple[Block, Register, Reading, int]]:
    """What all blocks report, with the width of their paths; a thread waits on each. Ends when the instance does.

    NotRunningError: a reload has removed a source or a register.
    """
    news: queue.Queue[list[News]] = queue.Queue(WAITING_FRAMES)
    followed: set[int] = set()
    chosen = choose(cell, patterns)
    width = _follow_new(chosen, followed, news)
    while True:
        try:
            batch = news.get(timeout=IDLE_S)
        except queue.Empty:
            if not cell.current:
                return
            continue
        if not batch:  # a reload has ended a block
            if not cell.current:
                return
            chosen = _choose_again(cell, patterns, {block.source for block, _ in chosen})
            width = _follow_new(chosen, followed, news)
        yield from ((*item, width) for item in batch)


def _choose_again(cell: Attachment, patterns: list[str], sources: set[str]) -> list[Selected]:
    """What the patterns name after a reload; ``sources``: of what they named before. NotRunningError."""
    try:
        return choose(cell, patterns)
    except PathError as error:
        if gone := sorted(sources.difference(cell.sources)):
            named = f"source {gone[0]!r} was" if len(gone) == 1 else f"sources {', '.join(gone)} were"
            raise NotRunningError(f"{named} removed from instance {cell.instance!r} by a reload") from None
        raise NotRunningError(f"{error}: a reload has taken it away") from None


def _follow_new(chosen: list[Selected], followed: set[int], news: queue.Queue[list[News]]) -> int:
    """Have a thread follow each block that none follows yet; the width of the longest path."""
    registers: dict[int, tuple[Block, list[Register]]] = {}
    for block, register in chosen:
        if block.section not in followed:
            registers.setdefault(block.section, (block, []))[1].append(register)
    followed.update(registers)
    for block, wanted in registers.values():
        threading.Thread(target=_follow, args=(block, wanted, news), daemon=True).start()
    return max(len(topic_path(*item)) for item in chosen)


def _follow(block: Block, registers: list[Register], news: queue.Queue[list[News]]) -> None:
    """Report each register's reading, then every change of value or quality; an empty list when the block ends."""
    shown: list[tuple[str, Quality, str] | None] = [None] * len(registers)
    cursor = block.cursor()
    frame: Frame | None = block.latest()
    while True:
        changes: list[News] = []
        for index, register in enumerate(registers):
            now = reading(block, register, frame)
            # A stale reason holds the age: its text changes, the fact does not.
            state = (repr(now.value), now.quality, now.reason.partition(":")[0])  # repr: a NaN equals itself
            if state != shown[index]:
                shown[index] = state
                changes.append((block, register, now))
        if changes:
            news.put(changes)
        if block.retired:
            news.put([])
            return
        if cursor.behind > WAITING_FRAMES:
            cursor = block.cursor(after=block.ring.head() - 1)
        frame = cursor.next(timeout_s=min(IDLE_S, block.stale_ns / 1e9)) or block.latest()


def _clock(now: Reading) -> str:
    """The value's own time; of one that is bad, when that was noticed."""
    if now.quality is Quality.BAD:
        return datetime.now(UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
    if now.source_time is None:
        return "-" * 12
    return datetime.fromtimestamp(now.source_time, UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
