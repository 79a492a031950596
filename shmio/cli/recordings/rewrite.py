"""``shmio-dump cut``, ``merge`` and ``recover``: write a new recording, and check it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from shmio.cli.common import dumps, say
from shmio.cli.recordings.common import DamageReport, Progress, not_closed, time_range
from shmio.cli.recordings.examine import checked, checked_lines
from shmio.errors import RecordingError
from shmio.recording import rewriting
from shmio.recording.dump import Dump, open_dump
from shmio.recording.format.records import Damage
from shmio.recording.reading.part import Entry
from shmio.recording.reading.reader import Item
from shmio.recording.rewriting import Rewriter, part
from shmio.recording.times import lost
from shmio.wording import EMPTY

MAX_TOLD = 1000


def cut(arguments: argparse.Namespace) -> int:
    """Write the entries between two times to a new file, for the chosen sources and registers; by default, for all."""
    report = DamageReport()
    with report.open(arguments.files) as dump:
        from_ns, to_ns = time_range(arguments, dump.begin_ns)
        entries = part(dump, from_ns, to_ns, arguments.sources, arguments.only or ())
        work = _rewrite(dump, arguments.output, "shmio-dump cut", entries, whole=False)
    verified_lines = _verified(arguments.output)
    if arguments.json:
        print(dumps({"file": str(arguments.output), **work.counts, "damage": report.texts}, indent=2))
        return int(report.any)
    for line in verified_lines:
        say(line)
    say(f"  {work.counts['frames']} frames and {work.counts['events']} events")
    return int(report.any)


def merge(arguments: argparse.Namespace) -> int:
    """Write the contents of all files to a new file, in order of time and without duplicates."""
    report = DamageReport()
    with report.open(arguments.files) as dump:
        work = _rewrite(dump, arguments.output, "shmio-dump merge", dump.items())
    for line in _verified(arguments.output):
        say(line)
    say(f"  {work.counts['frames']} frames and {work.counts['events']} events of {len(arguments.files)} files")
    return int(report.any)


def recover(arguments: argparse.Namespace) -> int:
    """Write all messages of intact chunks to a new, closed file; report what was lost."""
    file: Path = arguments.file
    path = arguments.output or file.parent / f"{file.stem}-recovered{file.suffix}"
    places: list[str] = []

    def damaged(_: Path, damage: Damage) -> None:
        if len(places) < MAX_TOLD:
            places.append(lost(damage))

    with open_dump(file, damaged) as dump:
        if not dump.blocks:
            raise RecordingError(dump.damage[0] if dump.damage else f"{file}: {EMPTY}")
        layouts = [text for text in dump.damage if "layout" in text]
        records = dump.readers[0].records
        end = "" if records.closed else records.damage
        work = _rewrite(dump, path, "shmio-dump recover", dump.items())
    for line in _verified(path):
        say(line)
    counts = work.counts
    say(f"  {counts['frames']} frames and {counts['events']} events of {file}")
    for text in [*layouts, *places]:
        say(f"  {text}")
    if end:
        say(f"  {file}: {not_closed(end)}")
    say(f"  {work.damaged} frames and events between these are lost" if work.damaged else "  nothing between is lost")
    return 0


def _rewrite(dump: Dump, path: Path, made: str, entries: Iterable[Entry[Item]], *, whole: bool = True) -> Rewriter:
    """Write entries to a new file with :func:`shmio.recording.rewriting.rewrite`.

    Show the progress.
    """
    with Progress(f"writing {path}") as progress:
        progress.total = dump.end_ns - dump.begin_ns
        return rewriting.rewrite(dump, path, made, entries, whole=whole, progress=progress.at)


def _verified(path: Path) -> list[str]:
    """Read a new file completely, and return lines about it.

    Raises:
        RecordingError: The file is damaged.

    """
    found = checked(path)
    if found["damage"]:
        raise RecordingError(f"{path}: {found['damage'][0]}")
    return checked_lines(found)
