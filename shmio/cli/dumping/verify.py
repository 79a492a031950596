"""``shmio-dump verify``: whether recordings are whole."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from shmio.cli.dumping.moments import lost
from shmio.cli.dumping.progress import Progress
from shmio.cli.run import dumps
from shmio.dump.check import check
from shmio.dump.reader import Reader
from shmio.errors import RecordingError
from shmio.logs import printable


def execute(arguments: argparse.Namespace) -> int:
    """Read all of each file; 1 if one of them is damaged, or no recording."""
    found, failed = [], False
    for file in arguments.files:
        try:
            verified = verify(file)
        except (RecordingError, OSError) as error:
            text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
            print(printable(text), file=sys.stderr)
            failed = True
            continue
        failed = failed or bool(verified["damage"])
        found.append(verified)
        if not arguments.json:
            print("\n".join(map(printable, lines(verified))), flush=True)
    if arguments.json and found:
        print(dumps(found[0] if len(arguments.files) == 1 else found, indent=2))
    return int(failed)


def verify(file: Path) -> dict[str, Any]:
    """What a look at all of a file tells. OSError, RecordingError: it is no recording."""
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
    """For people."""
    ended = "closed" if found["closed"] else f"not closed ({found['end']}): still being written, or cut off"
    whole = f"{found['chunks']} chunks and {found['messages']} messages are whole"
    return [f"{found['file']}: {ended}; {whole}{'' if found['damage'] else ', no damage'}"] + [
        f"  damage: {text}" for text in found["damage"]
    ]
