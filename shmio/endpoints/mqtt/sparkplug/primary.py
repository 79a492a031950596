"""The host application that an edge node waits for, by its STATE topic (Eclipse Sparkplug Specification 3.0.0, 5.4)."""

from __future__ import annotations

import logging
import time
from typing import Final

import msgspec

from shmio.endpoints.mqtt.sparkplug.node import NAMESPACE

AHEAD_MS: Final = 86_400_000
"""The clock of a host may be ahead of ours, by no more than this."""

log = logging.getLogger("shmio.mqtt")


class _State(msgspec.Struct):
    online: bool
    timestamp: int | float


class PrimaryHost:
    """What it says on the present connection."""

    def __init__(self, name: str) -> None:
        self.topic = f"{NAMESPACE}/STATE/{name}"
        self.online: bool | None = None
        """None: it has said nothing."""
        self._at_ms = float("-inf")

    def forget(self) -> None:
        """There is another connection: each broker has been told at another time."""
        self.online, self._at_ms = None, float("-inf")

    def hear(self, payload: bytes) -> None:
        """Take in what it says, unless it is older than what it said before: the late will of a session before."""
        try:
            state = msgspec.json.decode(payload, type=_State)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            log.warning("%s: expected JSON with online, true or false, and a timestamp", self.topic)
            return
        if state.timestamp > time.time() * 1000 + AHEAD_MS:  # none that comes would be newer
            log.warning("%s: the timestamp is more than a day ahead; it is in ms since 1970", self.topic)
        elif state.timestamp >= self._at_ms:
            self.online, self._at_ms = state.online, state.timestamp
