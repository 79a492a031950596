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
    """Messages, or calls, that were refused, in all; for the event loop's thread."""

    def __init__(self, what: str = "publish refused", about: str = "topic", turn_s: float = TURN_S) -> None:
        """``about``: the name that the log has for what was refused."""
        self.count = 0
        self._what = what
        self._about = about
        self._turn_s = turn_s
        self._in_turn = 0

    def add(self, reason: str, name: str, peer: str) -> None:
        """Count one, and log it if there is a line left."""
        self.count += 1
        self._in_turn += 1
        if self._in_turn == 1:
            asyncio.get_running_loop().call_later(self._turn_s, self._end_turn)
        if self._in_turn <= LINES:
            log.warning("%s: %s", self._what, reason, extra=fields(**{self._about: shorten(name)}, peer=peer))

    def _end_turn(self) -> None:
        if self._in_turn > LINES:
            log.warning("%s: %d more in %g s", self._what, self._in_turn - LINES, self._turn_s)
        self._in_turn = 0
