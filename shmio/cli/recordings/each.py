"""Examine files one by one, for ``info`` and ``verify``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from shmio.cli.run import dumps
from shmio.errors import RecordingError
from shmio.logs import printable


def each(
    arguments: argparse.Namespace,
    look: Callable[[Path], dict[str, Any]],
    lines: Callable[[dict[str, Any]], Iterable[str]],
) -> int:
    """Print what ``look`` finds in each file, as ``lines`` or JSON.

    ``look`` raises OSError or RecordingError for a file that is not a recording; in JSON the error
    takes the place of the result. Returns 1 if a file is damaged or not a recording.
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


def ended(found: dict[str, Any]) -> str:
    """Return how a file ends, as text: by its ``closed`` and ``end``."""
    return "closed" if found["closed"] else not_closed(found["end"])


def not_closed(end: str) -> str:
    """Return the text about a file that was not closed; all commands use it."""
    return f"not closed ({end}): still being written, or its recorder was killed"
