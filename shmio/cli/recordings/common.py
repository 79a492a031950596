"""Code shared by verbs of ``shmio-dump``: damage reports, progress, ``--from`` and ``--to``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from shmio.errors import RecordingError
from shmio.fabric.place import Place, is_place, parse_place
from shmio.local.replays import date_ns, moment_ns
from shmio.recording.dump import Dump, open_dump
from shmio.recording.format.records import Damage
from shmio.recording.reading.part import MAX_NS
from shmio.recording.times import lost
from shmio.wording import printable

FIRST_S = 1.0
"""Time in s after which progress is shown; shorter work shows none."""
EACH_S = 0.2
"""Interval in s at which the displayed progress is updated."""


class DamageReport:
    """Reports the damaged parts of a recording on standard error, between the lines of the output."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    @property
    def any(self) -> bool:
        """True if anything was reported."""
        return bool(self.texts)

    def open(self, files: Sequence[Path]) -> Dump:
        """Open a recording, and report its damage. This raises the same errors as ``open_dump``."""
        dump = open_dump(files, self.damage)
        for text in dump.damage:
            self.say(text)
        return dump

    def damage(self, file: Path, damage: Damage) -> None:
        """Report that a part of a file is damaged."""
        self.say(f"{file}: {lost(damage)}")

    def say(self, text: str) -> None:
        """Report a line of text. The command's exit status will be 1."""
        self.texts.append(text)
        sys.stdout.flush()
        print(printable(text), file=sys.stderr, flush=True)


def not_closed(end: str) -> str:
    """Return a text which says that a file was not closed. ``end`` says how the file ends."""
    return f"not closed ({end}): it is still being written, or its recorder was killed"


class Progress:
    """Shows progress on standard error in a line that is removed at the end, if standard error is a terminal.

    Use it as a context manager.
    """

    def __init__(self, what: str, *, silent: bool = False) -> None:
        """Create the line. With ``silent``, nothing is shown, because the terminal shows other output."""
        self.total = 0
        """Total amount of work: in bytes of the file, or in ns of the recording."""
        self._what = what
        self._shown = False
        self._next_s = time.monotonic() + FIRST_S if sys.stderr.isatty() and not silent else float("inf")

    def at(self, done: int) -> None:
        """Show the progress. ``done`` is the amount of work done, in the unit of :attr:`total`."""
        if time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + EACH_S
            share = f"{min(done / self.total, 1):4.0%}" if self.total else ""
            self._show(f"\r{printable(self._what)} {share}\x1b[K")
            self._shown = True

    def _show(self, text: str) -> None:
        with suppress(OSError):
            sys.stderr.write(text)
            sys.stderr.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._show("\r\x1b[K")


def time_range(arguments: argparse.Namespace, start_ns: int) -> tuple[int, int]:
    """Return the times given by ``--from`` and ``--to``, in ns. An omitted option does not limit the range.

    The options are in s from the recording's start, or in ISO 8601. A time without an offset is
    local.

    Args:
        arguments: The parsed arguments.
        start_ns: Start of the recording.

    Raises:
        RecordingError: A time is invalid, or the end is before the start.

    """
    begin, end = arguments.begin, arguments.end
    from_ns = 0 if begin is None else _parse("--from", begin, start_ns)
    to_ns = MAX_NS if end is None else _parse("--to", end, start_ns)
    if from_ns > to_ns:
        raise RecordingError(f"--to {end} is before --from {begin}")
    return from_ns, to_ns


@contextmanager
def local_files(arguments: argparse.Namespace) -> Iterator[list[Path]]:
    """Yield the files of a command; a cell's history in a fabric becomes a temporary file."""
    with TemporaryDirectory(prefix="shmio-") as folder:
        yield [
            _fetched(name, arguments, Path(folder) / f"{index}.mem") if is_place(name) else Path(name)
            for index, name in enumerate(arguments.files)
        ]


def _fetched(name: str, arguments: argparse.Namespace, file: Path) -> Path:
    fetch_history(name, arguments, file)
    return file


def fetch_history(name: str, arguments: argparse.Namespace, file: Path) -> int:
    """Write a cell's history between ``--from`` and ``--to`` to a file; return the number of its frames.

    Raises:
        ConfigError: The options for the server do not fit together, or a file cannot be used.
        RecordingError: A time is invalid, or there is no history.
        RemoteError: No server can be reached.

    """
    from shmio.cli.fabric.access import access_of  # noqa: PLC0415  most recordings are files
    from shmio.fabric.history import fetch  # noqa: PLC0415

    url, cell = parse_place(name)
    place = Place(access_of(name, [url], arguments), cell)
    begin_ns, end_ns = _date("--from", arguments.begin), _date("--to", arguments.end)
    if begin_ns is not None and end_ns is not None and end_ns < begin_ns:
        raise RecordingError(f"--to {arguments.end} is before --from {arguments.begin}")
    with Progress(f"reading the history of {cell}"):
        return fetch(place, file, begin_ns, end_ns)


def _date(option: str, text: str | None) -> int | None:
    try:
        return None if text is None else date_ns(text)
    except (ValueError, TypeError):
        raise RecordingError(
            f"{option}: {text!r} is not a time such as 2026-11-21T08:30:00, which a history needs"
        ) from None


def _parse(option: str, text: str, start_ns: int) -> int:
    try:
        return min(max(0, moment_ns(text, start_ns)), MAX_NS)
    except (ValueError, TypeError):  # argparse makes a list of --from=--
        raise RecordingError(
            f"{option}: {text!r} is neither a time such as 2026-11-21T08:30:00 nor seconds of the recording"
        ) from None
