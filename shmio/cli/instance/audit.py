"""``shmio-supervisor audit``: prints who did what to the instance."""

from __future__ import annotations

import argparse
import sys
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio import control
from shmio.audit.reading import EntryFilter, entries, parse_entry, present_files
from shmio.audit.trail import Entry, words_of
from shmio.cli.common import dumps
from shmio.cli.target import target
from shmio.config import load
from shmio.errors import ConfigError
from shmio.local.log_files import Follower
from shmio.local.supervisor import ask_supervisor
from shmio.plan.processes import AUDIT_FILE
from shmio.times import utc_text
from shmio.wording import printable

WHERE_S: Final = 5.0


def audit(arguments: argparse.Namespace) -> int:
    """Print the last entries that match the options; with ``-f``, also new entries until Ctrl-C."""
    newest = _where(arguments) / AUDIT_FILE
    since_s = arguments.since or 0.0
    wanted = EntryFilter(
        utc_text(since_s) if since_s else "", arguments.who or "", arguments.action or "", arguments.pattern or ""
    )
    try:
        if not present_files(newest) and not (arguments.follow and newest.parent.is_dir()):
            raise ConfigError(f"no audit log in {newest.parent}: `[instance] audit` is false, or nothing has run yet")
        if not arguments.follow:
            _print(_last(newest, since_s, wanted, arguments.lines), as_json=arguments.json)
            return 0
        with Follower([newest]) as follower:
            _print(_last(newest, since_s, wanted, arguments.lines), as_json=arguments.json)
            while True:
                new = (entry for line in follower.wait() if (entry := parse_entry(line)) is not None)
                _print(filter(wanted.chooses, new), as_json=arguments.json)
    except OSError as error:
        raise ConfigError(f"{error.filename or newest}: {error.strerror}") from None


def _last(newest: Path, since_s: float, wanted: EntryFilter, count: int | None) -> Iterable[Entry]:
    """Return the last ``count`` entries that match.

    If ``count`` is None, return all entries since ``since_s``, or the last 50 if ``since_s`` is 0.
    """
    most = count if count is not None else None if since_s else 50
    return deque(filter(wanted.chooses, entries(newest, since_s)), maxlen=most)


def _where(arguments: argparse.Namespace) -> Path:
    """Return the folder of the log files, from the configuration or else from the running instance."""
    wanted = target(arguments)
    if wanted.file is not None:
        return load(wanted.file).log_dir
    with wanted.open_supervised() as segment:
        return Path(ask_supervisor(segment, control.Where(), WHERE_S)["log_dir"])


def _print(found: Iterable[Entry], *, as_json: bool) -> None:
    for entry in found:
        print(dumps(msgspec.to_builtins(entry)) if as_json else printable(line_of(entry)))
    sys.stdout.flush()


def line_of(entry: Entry) -> str:
    """Return an entry as a line of text."""
    who = words_of(entry.endpoint, entry.kind, entry.who, entry.origin)
    what = ", ".join(_shown(key, value) for key, value in entry.what.items()) if isinstance(entry.what, dict) else ""
    more = f" and {entry.left_out} more" if entry.left_out else ""
    reason = f": {entry.reason}" if entry.reason else ""
    about = f" {what}{more}" if what else ""
    action = entry.action if entry.count == 1 else f"{entry.count} times {entry.action}"
    return f"{entry.time} {who}: {action}{about}: {entry.outcome}{reason}"


def _shown(key: str, value: Any) -> str:
    return f"{key} = {value if value and isinstance(value, str) else dumps(value)}"
