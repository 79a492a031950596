"""Reads the entries of an audit log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio.audit.trail import Entry

SUPERVISOR: Final = "supervisor"
"""Process name of the supervisor, which also writes the entries for programs on this host."""
MAX_LINE_BYTES: Final = 1 << 16

_decode: Final = msgspec.json.Decoder(Entry).decode


def present_files(newest: Path) -> list[Path]:
    """Return the existing files of an audit log, the oldest first."""
    numbered = {
        int(number): path
        for path in newest.parent.glob(f"{newest.name}.*")
        if (number := path.name.removeprefix(f"{newest.name}.")).isdecimal() and number.isascii()
    }
    older = [numbered[number] for number in sorted(numbered, reverse=True)]
    return [*older, newest] if newest.exists() else older


def parse_entry(line: bytes) -> Entry | None:
    """Return the entry that a line contains; None if the line is damaged."""
    try:
        return _decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None


def entries(newest: Path, since_s: float = 0.0) -> Iterator[Entry]:
    """Yield the entries of an audit log, the oldest first. Damaged lines are skipped.

    Args:
        newest: The newest file.
        since_s: UNIX time in s. Files last written before this time are skipped. Files written
            later can still yield earlier entries.

    Raises:
        OSError: A file cannot be read.

    """
    for path in present_files(newest):
        with suppress(FileNotFoundError):  # another process has rotated meanwhile
            if path.stat().st_mtime < since_s:
                continue
            with path.open("rb") as stream:
                while line := stream.readline(MAX_LINE_BYTES):
                    if (entry := parse_entry(line)) is not None:
                        yield entry


@dataclass(frozen=True, slots=True)
class EntryFilter:
    """Selects entries of an audit log. An empty field matches every entry.

    Attributes:
        since: Earliest time, in the format of :attr:`Entry.time`.
        who: Pattern that the name or the kind of the actor must match.
        action: The action that the entry must have.
        pattern: Pattern that a path or another word in :attr:`Entry.what` must match.

    """

    since: str = ""
    who: str = ""
    action: str = ""
    pattern: str = ""

    def chooses(self, entry: Entry) -> bool:
        """Return whether the filter selects this entry."""
        return (
            entry.time >= self.since
            and (not self.who or fnmatchcase(entry.who, self.who) or fnmatchcase(entry.kind, self.who))
            and self.action in ("", entry.action)
            and (not self.pattern or any(fnmatchcase(word, self.pattern) for word in _words(entry.what)))
        )


def _words(what: Any) -> Iterator[str]:
    if isinstance(what, str):
        yield what
    elif isinstance(what, Mapping):
        for key, value in what.items():
            yield key
            yield from _words(value)
    elif isinstance(what, list):
        for value in what:
            yield from _words(value)


def last_events(newest: Path, since: str) -> dict[str, int]:
    """Return the highest event number that the supervisor has recorded since a time, by source.

    The result is empty if a file cannot be read.
    """
    found: dict[str, int] = {}
    try:
        for entry in entries(newest):
            if entry.event and entry.process == SUPERVISOR and entry.time >= since:
                source = source_of(entry)
                found[source] = max(entry.event, found.get(source, 0))
    except OSError:  # then the commands of this run are recorded again
        return {}
    return found


def source_of(entry: Entry) -> str:
    """Return the source that an entry is about; empty if there is none."""
    if not isinstance(entry.what, Mapping) or not entry.what:
        return ""
    named = entry.what.get("source")
    return named if isinstance(named, str) else str(next(iter(entry.what))).partition("/")[0]
