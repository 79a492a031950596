"""What clients can have logged is rationed: none of them fills the log, whatever it does again and again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final

LINES: Final = 20
"""Most lines of one kind in a turn."""
TURN_S: Final = 10.0


class LogRateLimit(logging.Filter):
    """Lets so many records of one kind, by its text without what is filled in, through in a turn; counts the others.

    The first of a later turn tells how many were left out. For loggers that any thread may use.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic, *, one_kind: bool = False) -> None:
        """``one_kind``: all records are; for loggers of others, who fill in their texts themselves."""
        super().__init__()
        self._clock_s = clock_s
        self._one_kind = one_kind
        self._kinds: dict[str, tuple[float, int]] = {}
        """By kind: when its turn ends, and how many came in it."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether it is written."""
        now_s, text = self._clock_s(), str(record.msg)
        kind = "" if self._one_kind else text
        until_s, count = self._kinds.get(kind, (0.0, 0))
        if now_s < until_s:
            self._kinds[kind] = until_s, count + 1
            return count < LINES
        self._kinds[kind] = now_s + TURN_S, 1
        if count > LINES:
            record.msg = f"{text} ({count - LINES} more like this were left out before)"
        return True
