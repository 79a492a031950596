"""Times of recordings, as options say them and as they are printed."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime

from shmio.errors import RecordingError
from shmio.local.recording_times import moment_ns
from shmio.recording.format.damage import Damage
from shmio.recording.reading.part import MAX_NS


def time_range(arguments: argparse.Namespace, start_ns: int) -> tuple[int, int]:
    """Log times in ns of ``--from`` and ``--to``: seconds from the recording's start, or ISO 8601, local unless told.

    Without them all there is. RecordingError for what is neither, and for an end before its beginning.
    """
    begin, end = arguments.begin, arguments.end
    from_ns = 0 if begin is None else _parse("--from", begin, start_ns)
    to_ns = MAX_NS if end is None else _parse("--to", end, start_ns)
    if from_ns > to_ns:
        raise RecordingError(f"--to {end} is before --from {begin}")
    return from_ns, to_ns


def _parse(option: str, text: str, start_ns: int) -> int:
    try:
        return min(max(0, moment_ns(text, start_ns)), MAX_NS)
    except (ValueError, TypeError):  # argparse makes a list of --from=--
        raise RecordingError(
            f"{option}: {text!r} is neither a time such as 2026-11-21T08:30:00 nor seconds of the recording"
        ) from None


def iso(time_ns: int) -> str:
    """UTC with µs, for JSON."""
    return _datetime(time_ns).isoformat(timespec="microseconds").replace("+00:00", "Z")


def local(time_ns: int) -> str:
    """Local date and time with ms, for people."""
    return _datetime(time_ns).astimezone().isoformat(" ", timespec="milliseconds")[:23]


def span(first_ns: int, last_ns: int) -> str:
    """From when to when, for people."""
    return f"from {local(first_ns)} to {local(last_ns)}"


def lost(damage: Damage) -> str:
    """Where something is lost, in time and in the file, and why."""
    begin = f"after {local(damage.after_ns)}" if damage.after_ns else "from the beginning"
    end = f"before {local(damage.before_ns)}" if damage.before_ns else "to the end"
    return f"lost {begin}, {end} (bytes {damage.first} to {damage.last}): {damage.why}"


def _datetime(time_ns: int) -> datetime:
    """A file may say any time; what no calendar has is its nearest."""
    return datetime.fromtimestamp(min(time_ns, 253_000_000_000 * 10**9) // 1000 / 1e6, UTC)
