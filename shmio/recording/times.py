"""Formats times and damaged places of a recording as text."""

from __future__ import annotations

from datetime import UTC, datetime

from shmio.recording.format.records import Damage


def iso(time_ns: int) -> str:
    """Format a time in ns as UTC with µs, for JSON and tables."""
    return _datetime(time_ns).isoformat(timespec="microseconds").replace("+00:00", "Z")


def local(time_ns: int) -> str:
    """Format a time in ns as local date and time with ms, for people."""
    return _datetime(time_ns).astimezone().isoformat(" ", timespec="milliseconds")[:23]


def span(first_ns: int, last_ns: int) -> str:
    """Format a range of time, given by its first and last time in ns, in local date and time, for people."""
    return f"from {local(first_ns)} to {local(last_ns)}"


def lost(damage: Damage) -> str:
    """Return a message about a damaged place: its time, its bytes and the reason."""
    begin = f"after {local(damage.after_ns)}" if damage.after_ns else "from the beginning"
    end = f"before {local(damage.before_ns)}" if damage.before_ns else "to the end"
    return f"lost {begin}, {end} (bytes {damage.first} to {damage.last}): {damage.why}"


def _datetime(time_ns: int) -> datetime:
    """Convert a time in ns to a datetime. Clamp it, because a damaged file may have any time."""
    return datetime.fromtimestamp(min(time_ns, 253_000_000_000 * 10**9) // 1000 / 1e6, UTC)
