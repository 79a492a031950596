"""Read the options ``--from`` and ``--to``."""

from __future__ import annotations

import argparse

from shmio.errors import RecordingError
from shmio.local.replays import moment_ns
from shmio.recording.reading.part import MAX_NS


def time_range(arguments: argparse.Namespace, start_ns: int) -> tuple[int, int]:
    """Return the log times of ``--from`` and ``--to`` in ns; without them, everything.

    They are seconds from the recording's start, or ISO 8601, in local time without an offset.

    Raises:
        RecordingError: A time is invalid, or the end is before the beginning.
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
