"""Formats times and damaged places of a recording as text."""

from __future__ import annotations

from shmio.recording.format.records import Damage
from shmio.times import local_text, utc_text


def iso(time_ns: int) -> str:
    """Format a time in ns as UTC with µs, for JSON and tables."""
    return utc_text(_seconds(time_ns))


def local(time_ns: int) -> str:
    """Format a time in ns as local date and time with ms, for people."""
    return local_text(_seconds(time_ns))


def span(first_ns: int, last_ns: int) -> str:
    """Format a range of time, given by its first and last time in ns, in local date and time, for people."""
    return f"from {local(first_ns)} to {local(last_ns)}"


def lost(damage: Damage) -> str:
    """Return a message about a damaged place: its time, its bytes and the reason."""
    begin = f"after {local(damage.after_ns)}" if damage.after_ns else "from the beginning"
    end = f"before {local(damage.before_ns)}" if damage.before_ns else "to the end"
    return f"lost {begin}, {end} (bytes {damage.first} to {damage.last}): {damage.why}"


def _seconds(time_ns: int) -> float:
    """Convert a time in ns to s. Clamp it, because a damaged file may have any time."""
    return min(time_ns, 253_000_000_000 * 10**9) // 1000 / 1e6
