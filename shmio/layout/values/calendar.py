"""Convert exactly between ISO 8601 text and nanoseconds since 1970-01-01.

This module uses whole numbers and text, because LDT and DTL have nanoseconds and Python's
``datetime`` has only microseconds. Like S7, it knows no time zones.
"""

from __future__ import annotations

import re
from datetime import date

NS_PER_MS = 1_000_000
NS_PER_SECOND = 1_000_000_000
NS_PER_DAY = 86_400 * NS_PER_SECOND
EPOCH = date(1970, 1, 1).toordinal()
DATE_EPOCH_DAYS = date(1990, 1, 1).toordinal() - EPOCH

# The last moment of LDT: 2262-04-11T23:47:16.854775807, as nanoseconds in 63 bits.
LAST_NS = (1 << 63) - 1
# The last moment of DTL: its year has 16 bits, and ISO 8601 ends with 9999.
LAST_DTL_NS = (date(9999, 12, 31).toordinal() - EPOCH + 1) * NS_PER_DAY - 1
FIRST_DT_NS = DATE_EPOCH_DAYS * NS_PER_DAY
LAST_DT_NS = (date(2090, 1, 1).toordinal() - EPOCH) * NS_PER_DAY - NS_PER_MS

_MOMENT = re.compile(
    r"([0-9]{4})-([0-9]{1,2})-([0-9]{1,2})"
    r"(?:[T -]([0-9]{1,2}):([0-9]{1,2})(?::([0-9]{1,2})(?:\.([0-9]{1,9}))?)?)?",
    re.ASCII,
)


def days(year: int, month: int, day: int) -> int | None:
    """Return the number of days from 1970-01-01 to a date; None if there is no such date."""
    try:
        return date(year, month, day).toordinal() - EPOCH
    except ValueError:
        return None


def parse_moment(text: str) -> int | None:
    """Convert a date, with or without a time, to ns since 1970; return None if the text is neither.

    Accept ``2024-02-29``, ``2024-02-29T12:00:00.5`` and S7's ``2024-2-29-12:00:00.5``.
    """
    match = _MOMENT.fullmatch(text)
    day = days(int(match[1]), int(match[2]), int(match[3])) if match else None
    if match is None or day is None:
        return None
    hour, minute, second = (int(match[group] or 0) for group in (4, 5, 6))
    if hour > 23 or minute > 59 or second > 59:
        return None
    fraction = int((match[7] or "").ljust(9, "0"))
    return day * NS_PER_DAY + ((hour * 60 + minute) * 60 + second) * NS_PER_SECOND + fraction


def format_day(day: int) -> str:
    """Return a day, given in days since 1970, as ISO text."""
    return date.fromordinal(EPOCH + day).isoformat()


def format_moment(ns: int, digits: int) -> str:
    """Return a time, given in nanoseconds since 1970, as ISO text; seconds have ``digits`` decimals."""
    day, rest = divmod(ns, NS_PER_DAY)
    second, fraction = divmod(rest, NS_PER_SECOND)
    clock = f"{second // 3600:02}:{second // 60 % 60:02}:{second % 60:02}"
    return f"{format_day(day)}T{clock}.{fraction:09}"[: 20 + digits]


def weekday(ns: int) -> int:
    """Return the day of the week as S7 counts it: 1 is Sunday."""
    return (ns // NS_PER_DAY + 4) % 7 + 1  # 1970-01-01 was a Thursday
