"""Counting and logging what clients sent in vain; one that does nothing else must not fill the log."""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from shmio.layout.topic import shorten
from shmio.logs import fields

TURN_S: Final = 10.0
LINES: Final = 10
"""Most lines in a turn; of what is more, one line tells how many."""

log = logging.getLogger("shmio.grpc")


class Refusals:
    """Messages that were refused, in all; for the event loop's thread."""

    def __init__(self, turn_s: float = TURN_S) -> None:
        self.count = 0
        self._turn_s = turn_s
        self._in_turn = 0

    def add(self, reason: str, topic: str, peer: str) -> None:
        """Count one, and log it if there is a line left."""
        self.count += 1
        self._in_turn += 1
        if self._in_turn == 1:
            asyncio.get_running_loop().call_later(self._turn_s, self._end_turn)
        if self._in_turn <= LINES:
            log.warning("publish refused: %s", reason, extra=fields(topic=shorten(topic), peer=peer))

    def _end_turn(self) -> None:
        if self._in_turn > LINES:
            log.warning("publish refused: %d more in %g s", self._in_turn - LINES, self._turn_s)
        self._in_turn = 0
