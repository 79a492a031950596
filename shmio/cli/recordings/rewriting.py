"""Write a new recording and verify it, for ``cut``, ``merge`` and ``recover``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from shmio.cli.recordings.progress import Progress
from shmio.cli.recordings.verify import lines, verify
from shmio.errors import RecordingError
from shmio.recording import rewriting
from shmio.recording.dump import Dump
from shmio.recording.reading.entries import Entry
from shmio.recording.reading.reader import Item
from shmio.recording.rewriting import Rewriter


def rewrite(dump: Dump, path: Path, made: str, entries: Iterable[Entry[Item]], *, whole: bool = True) -> Rewriter:
    """Write entries to a new file, with a line of progress; see :func:`shmio.recording.rewriting.rewrite`."""
    with Progress(f"writing {path}") as progress:
        progress.total = dump.end_ns - dump.begin_ns
        return rewriting.rewrite(dump, path, made, entries, whole=whole, progress=progress.at)


def verified(path: Path) -> list[str]:
    """Read a new file completely and return lines about it; RecordingError if it is damaged."""
    found = verify(path)
    if found["damage"]:
        raise RecordingError(f"{path}: {found['damage'][0]}")
    return lines(found)
