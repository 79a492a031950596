"""Formats times as text, for JSON and for people."""

from __future__ import annotations

from datetime import UTC, datetime


def utc_text(time_s: float, precision: str = "microseconds") -> str:
    """Format a time in s since 1970 as UTC, such as ``2026-11-27T16:03:13.833717Z``.

    Args:
        time_s: The time.
        precision: ``seconds``, ``milliseconds`` or ``microseconds``.

    """
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec=precision).replace("+00:00", "Z")


def local_text(time_s: float, precision: str = "milliseconds") -> str:
    """Format a time in s since 1970 as local date and time, such as ``2026-11-27 17:03:13.833``.

    Args:
        time_s: The time.
        precision: ``seconds``, ``milliseconds`` or ``microseconds``.

    """
    return datetime.fromtimestamp(time_s, UTC).astimezone().replace(tzinfo=None).isoformat(" ", precision)
