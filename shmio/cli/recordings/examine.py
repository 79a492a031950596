"""``shmio-dump info`` and ``verify``: examine recordings, file by file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from shmio.cli.common import dumps
from shmio.cli.recordings.common import Progress, not_closed
from shmio.errors import RecordingError
from shmio.recording.check import check
from shmio.recording.description import describe
from shmio.recording.format.encoding import SUPERVISED
from shmio.recording.reading.reader import Reader
from shmio.recording.times import local
from shmio.wording import EMPTY, counted, printable


def info(arguments: argparse.Namespace) -> int:
    """Describe each file; return 1 if a file is damaged or not a recording."""
    return _each(arguments, describe, lambda found: _folded(_lines(found)))


def _lines(found: dict[str, Any]) -> list[str]:
    size = f"{found['size'] / 1e6:.2f} MB"
    rate = f", {found['bytes_per_minute'] / 1e6:.2f} MB/min" if found["bytes_per_minute"] else ""
    recorder = "the instance's own recorder" if found["recorder"] == SUPERVISED else found["recorder"]
    by = f"recorded by {recorder}, shmio {found['version']}, on {found['host']}"
    if found["made_by"]:
        by += f"; converted by {found['made_by']}"
    lines = [
        f"{found['file']}: {size}, {_ended(found)}",
        f"  instance {found['instance']}, mode {found['mode']}, started {found['started']}; {by}",
        f"  {found['from']} to {found['to']}, {found['duration_s']:.1f} s{rate}"
        if found["from"]
        else "  no frames in it",
    ]
    if found["trigger"]:
        lines.append(f"  triggered {found['triggered']} by {found['trigger']}")
    if found["doubtful"]:
        where = f"after byte {found['doubtful_from']} of {found['doubtful']}"
        lines.append(f"  what is {where} may be lost, because the disk failed to store it (fsync)")
    for block in found["blocks"]:
        hertz = f" at {block['rate_hz']:.1f} Hz" if block["rate_hz"] else ""
        lines.append(
            f"  {block['source']}: {block['layout']}, {counted(block['registers'], 'register')}, "
            f"{counted(block['size'], 'byte')}, layout {block['layout_hash'][:12]}: "
            f"{counted(block['frames'], 'frame')}{hertz}, {counted(block['events'], 'event')}"
        )
    missed = f"{counted(found['missed_frames'], 'frame')} and {counted(found['missed_events'], 'event')} missed"
    lines.append(f"  {missed} in {counted(found['gap_count'], 'gap')}" if found["gap_count"] else "  nothing missed")
    lines += [f"    {_gap(gap)}" for gap in found["gaps"][:10]]
    return lines + [f"  damage: {text}" for text in found["damage"]]


def _folded(lines: list[str]) -> Iterator[str]:
    """Yield the lines; replace equal consecutive lines by one line with their number."""
    for line, alike in groupby(lines):
        count = sum(1 for _ in alike)
        yield line if count == 1 else f"{line} ({count} of these)"


def _gap(gap: dict[str, Any]) -> str:
    when = local(gap["before_ns"] or gap["after_ns"]) if gap["before_ns"] or gap["after_ns"] else "-"
    return f"{when}  {gap['source']}: {gap['count']} {gap['what']}, {gap['first']} to {gap['last']}: {gap['reason']}"


def verify(arguments: argparse.Namespace) -> int:
    """Check each file completely; return 1 if a file is damaged or not a recording."""
    return _each(arguments, checked, checked_lines)


def checked(file: Path) -> dict[str, Any]:
    """Check a file completely, and return what was found, as keys and values for JSON.

    Raises:
        OSError: The file cannot be read.
        RecordingError: The file is not a recording.
    """
    with Progress(f"verifying {file}") as progress, Reader(file) as reader:
        progress.total = reader.records.size
        found = check(reader, progress.at)
        return {
            "file": str(file),
            "size": reader.records.size,
            "closed": reader.records.closed,
            "end": reader.records.damage,
            "chunks": found.chunks,
            "messages": found.messages,
            "damage": found.texts(),
        }


def checked_lines(found: dict[str, Any]) -> list[str]:
    """Return the result of :func:`checked` as lines of text."""
    whole = f"{found['chunks']} chunks and {found['messages']} messages are whole"
    if not found["chunks"]:
        whole = EMPTY
    return [f"{found['file']}: {_ended(found)}; {whole}{'' if found['damage'] else ', no damage'}"] + [
        f"  damage: {text}" for text in found["damage"]
    ]


def _each(
    arguments: argparse.Namespace,
    look: Callable[[Path], dict[str, Any]],
    lines: Callable[[dict[str, Any]], Iterable[str]],
) -> int:
    """Print what ``look`` finds in each file, as text made by ``lines`` or as JSON.

    ``look`` raises OSError or RecordingError for a file that is not a recording. In JSON, the error
    replaces the result. Return 1 if a file is damaged or not a recording.
    """
    found: list[dict[str, Any]] = []
    failed = False
    for file in arguments.files:
        try:
            described = look(file)
        except (RecordingError, OSError) as error:
            text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
            print(printable(text), file=sys.stderr)
            found.append({"error": text})
            failed = True
            continue
        failed = failed or bool(described["damage"])
        found.append(described)
        if not arguments.json:
            print("\n".join(map(printable, lines(described))), flush=True)
    if arguments.json:
        print(dumps(found[0] if len(arguments.files) == 1 else found, indent=2))
    return int(failed)


def _ended(found: dict[str, Any]) -> str:
    """Return a text that says how a file ends, from the keys ``closed`` and ``end``."""
    return "closed" if found["closed"] else not_closed(found["end"])
