"""``shmio-dump verify``: check whether recordings are intact."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from shmio.cli.recordings.each import each, ended
from shmio.cli.recordings.progress import Progress
from shmio.recording.check import check
from shmio.recording.reading.reader import Reader
from shmio.recording.times import lost


def execute(arguments: argparse.Namespace) -> int:
    """Read each file completely; return 1 if one is damaged or not a recording."""
    return each(arguments, verify, lines)


def verify(file: Path) -> dict[str, Any]:
    """Return the result of reading a file completely; OSError, RecordingError: not a recording."""
    with Progress(f"verifying {file}") as progress, Reader(file) as reader:
        progress.total = reader.records.size
        found = check(reader, progress.at)
        texts = [lost(damage) for damage in found.damage] + found.problems
        if found.count > len(texts):
            texts.append(f"and {found.count - len(texts)} more such places")
        return {
            "file": str(file),
            "size": reader.records.size,
            "closed": reader.records.closed,
            "end": reader.records.damage,
            "chunks": found.chunks,
            "messages": found.messages,
            "damage": texts,
        }


def lines(found: dict[str, Any]) -> list[str]:
    """Return the result as lines of text."""
    whole = f"{found['chunks']} chunks and {found['messages']} messages are whole"
    if not found["chunks"]:
        whole = "nothing is recorded in it"
    return [f"{found['file']}: {ended(found)}; {whole}{'' if found['damage'] else ', no damage'}"] + [
        f"  damage: {text}" for text in found["damage"]
    ]
