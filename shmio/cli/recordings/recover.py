"""``shmio-dump recover``: write the intact parts of a damaged recording to a new file."""

from __future__ import annotations

import argparse
from pathlib import Path

from shmio.cli.recordings.each import not_closed
from shmio.cli.recordings.rewriting import rewrite, verified
from shmio.cli.run import say
from shmio.errors import RecordingError
from shmio.recording.dump import open_dump
from shmio.recording.format.damage import Damage
from shmio.recording.times import lost

MAX_TOLD = 1000


def execute(arguments: argparse.Namespace) -> int:
    """Write a closed file with all messages of all intact chunks, and report what was lost."""
    file: Path = arguments.file
    path = arguments.output or file.parent / f"{file.stem}-recovered{file.suffix}"
    places: list[str] = []

    def damaged(_: Path, damage: Damage) -> None:
        if len(places) < MAX_TOLD:
            places.append(lost(damage))

    with open_dump(file, damaged) as dump:
        if not dump.blocks:
            raise RecordingError(dump.damage[0] if dump.damage else f"{file}: nothing is recorded in it")
        layouts = [text for text in dump.damage if "layout" in text]
        records = dump.readers[0].records
        end = "" if records.closed else records.damage
        work = rewrite(dump, path, "shmio-dump recover", dump.items())
    for line in verified(path):
        say(line)
    counts = work.counts
    say(f"  {counts['frames']} frames and {counts['events']} events of {file}")
    for text in [*layouts, *places]:
        say(f"  {text}")
    if end:
        say(f"  {file}: {not_closed(end)}")
    say(f"  {work.damaged} frames and events between these are lost" if work.damaged else "  nothing between is lost")
    return 0
