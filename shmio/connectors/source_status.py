"""What a source's loop tells of itself: its counters, and each change of its quality."""

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
    """What ``status`` shows of a source; one writer, the loop."""

    polls: int = 0
    overruns: int = 0
    failures: int = 0
    connects: int = 0
    round_trip_us: int = 0
    busy_since_ns: int = 0
    """When the hook that runs now was called; 0 between hooks."""

    def watch(self, now_ns: Callable[[], int], hook: Callable[[], _Result]) -> _Result:
        """Call a hook, and let the main thread see since when."""
        self.busy_since_ns = now_ns()
        try:
            return hook()
        finally:
            self.busy_since_ns = 0


class QualityLog:
    """A source's quality as last told: in the log and in the block's events, once for each change."""

    def __init__(self, writer: BlockWriter) -> None:
        self._writer = writer
        self._state: tuple[Quality, str] | None = None  # the reason without its numbers
        self.note = ""
        """Why quality is not good, for the process table."""

    def tell(self, quality: Quality, reason: str, cycle: int, well: str = "") -> bool:
        """Log and write down a change of quality or of its reason; was it one? ``well``: for the log, if good."""
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
