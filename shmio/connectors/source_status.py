"""The status of a source: its counters, and the log lines and events about its quality."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from shmio.logs import fields
from shmio.segment import BlockWriter, EventKind, Quality, Record

_MEASURES = re.compile(r"\b[0-9]+(?= (?:ms|s|bytes)\b)")  # what varies in a reason; codes and addresses do not
_Result = TypeVar("_Result")

log = logging.getLogger("shmio.source")


@dataclass(slots=True)
class Counters:
    """The counters that ``status`` shows of a source. Only the loop writes them."""

    polls: int = 0
    overruns: int = 0
    failures: int = 0
    connects: int = 0
    round_trip_us: int = 0
    busy_since_ns: int = 0
    """When the running hook was called, ns; 0 between hooks."""

    def watch(self, now_ns: Callable[[], int], hook: Callable[[], _Result]) -> _Result:
        """Call a hook, and record for the main thread when the call began."""
        self.busy_since_ns = now_ns()
        try:
            return hook()
        finally:
            self.busy_since_ns = 0


class QualityLog:
    """Reports each change of a source's quality once, in the log and as an event."""

    def __init__(self, writer: BlockWriter) -> None:
        self._writer = writer
        self._state: tuple[Quality, str] | None = None  # the reason without its numbers
        self.note = ""
        """Why quality is not good, for the process table; empty if it is good."""

    def update(self, quality: Quality, reason: str, cycle: int, well: str = "") -> bool:
        """Report the quality if it or its reason has changed; numbers in the reason do not count.

        Args:
            quality: The present quality.
            reason: Why it is not good; empty if it is.
            cycle: The present cycle, for the log.
            well: Text for the log line if quality is good.

        Returns:
            Whether there was a change.

        """
        self.note = reason
        state = quality, _MEASURES.sub("#", reason)
        if state == self._state:
            return False
        self._state = state
        self._writer.event(Record(EventKind.QUALITY, reason), quality=quality)
        if quality is Quality.GOOD:
            log.info("quality good%s", well, extra=fields(cycle=cycle))
        else:
            log.warning("quality %s: %s", quality, reason, extra=fields(cycle=cycle))
        return True
