"""Moments of a recording, as people write them."""

from __future__ import annotations

from datetime import datetime


def moment_ns(text: str, begin_ns: int) -> int:
    """UTC in ns of so many seconds from ``begin_ns``, or of a date and time. ValueError: it is neither."""
    try:
        return begin_ns + round(float(text) * 1e9)
    except ValueError:
        return date_ns(text)
    except OverflowError:
        raise ValueError from None


def date_ns(text: str) -> int:
    """UTC in ns of a date and time, local unless it says. ValueError: it is none, or of no calendar."""
    try:
        return round(datetime.fromisoformat(text).astimezone().timestamp() * 1e6) * 1000
    except OverflowError:
        raise ValueError from None
