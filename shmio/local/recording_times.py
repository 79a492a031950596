"""Parse times of a recording as users write them."""

from __future__ import annotations

from datetime import datetime


def moment_ns(text: str, begin_ns: int) -> int:
    """Parse a time, given in seconds from ``begin_ns`` or as a date and time.

    Returns:
        UTC in ns.

    Raises:
        ValueError: The text is neither.
    """
    try:
        return begin_ns + round(float(text) * 1e9)
    except ValueError:
        return date_ns(text)
    except OverflowError:
        raise ValueError from None


def date_ns(text: str) -> int:
    """Parse a date and time in ISO 8601; local time, unless it names a time zone.

    Returns:
        UTC in ns.

    Raises:
        ValueError: The text is not a date and time.
    """
    try:
        return round(datetime.fromisoformat(text).astimezone().timestamp() * 1e6) * 1000
    except OverflowError:
        raise ValueError from None
