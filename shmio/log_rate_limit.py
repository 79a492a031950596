"""Limits the rate of log lines that clients can cause, so that no client can fill the log."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final

LINES: Final = 20
"""Most lines of one kind per turn."""
TURN_S: Final = 10.0


class LogRateLimit(logging.Filter):
    """Limits the records of one kind per turn. Safe for loggers in any thread.

    The unformatted text of a record is its kind. The first record of a later turn says how many
    were left out.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic, *, one_kind: bool = False) -> None:
        """Create the filter; with ``one_kind`` all records are of one kind, for foreign loggers."""
        super().__init__()
        self._clock_s = clock_s
        self._one_kind = one_kind
        self._kinds: dict[str, tuple[float, int]] = {}
        """By kind: when its turn ends, and how many records came in it."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is written."""
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
