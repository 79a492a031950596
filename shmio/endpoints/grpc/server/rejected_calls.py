"""Counts and logs refused messages and calls, with a limit on log lines."""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from shmio.layout.topic import shorten
from shmio.logs import fields

TURN_S: Final = 10.0
LINES: Final = 10
"""Most log lines in ``TURN_S``; one more line reports how many others there were."""

log = logging.getLogger("shmio.grpc")


class Refusals:
    """Counts and logs refused messages or calls; for the event loop's thread."""

    def __init__(self, what: str = "publish refused", about: str = "topic", turn_s: float = TURN_S) -> None:
        """``what`` begins each log line; ``about`` is the log field that names what was refused."""
        self.count = 0
        self._what = what
        self._about = about
        self._turn_s = turn_s
        self._in_turn = 0

    def add(self, reason: str, name: str, peer: str) -> None:
        """Count a refusal, and log it if the limit allows."""
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
