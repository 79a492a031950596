"""The newest events of all sources. They are read once for all pages."""

from __future__ import annotations

import time
from collections import deque
from typing import Any, Final

from shmio.local.events import EventReader
from shmio.model.event import Event
from shmio.segment import Segment

MAX_EVENTS: Final = 200
"""Maximum number of events that are kept."""
MAX_READ: Final = 500
"""Maximum number of a source's events that are read at a time. Further events stay in the ring until the next time."""
MAX_PATHS: Final = 8
"""Maximum number of paths that are kept for an event."""
INTERVAL_S: Final = 0.4
"""Time in s for which the list is reused."""


class Timeline:
    """Keeps the newest events. Use it in the event loop's thread only."""

    def __init__(self, segment: Segment) -> None:
        """Create an empty timeline."""
        self._segment = segment
        self._readers: dict[int, EventReader] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=MAX_EVENTS)
        self._list: list[dict[str, Any]] = []
        self._read_s = -INTERVAL_S

    def events(self) -> list[dict[str, Any]]:
        """Return the newest events, the oldest first. The list is at most half a second old."""
        now_s = time.monotonic()
        if now_s - self._read_s < INTERVAL_S:
            return self._list
        self._read_s = now_s
        found = sorted(self._new(), key=lambda event: event.utc_ns)
        if found:
            self._events.extend(map(_described, found))
            self._list = list(self._events)
        return self._list

    def _new(self) -> list[Event]:
        blocks = {block.section: block for block in self._segment.blocks.values()}
        self._readers = {
            section: self._readers.get(section) or EventReader(block, after=max(0, block.events.head() - MAX_EVENTS))
            for section, block in blocks.items()
        }
        found: list[Event] = []
        for reader in self._readers.values():
            for _ in range(MAX_READ):
                if (event := reader.next()) is None:
                    break
                found.append(event)
        return found


def _described(event: Event) -> dict[str, Any]:
    return {
        "time_s": event.utc_ns / 1e9,
        "source": event.source,
        "kind": str(event.kind),
        "by": event.by,
        "cycle": event.cycle,
        "text": event.text,
        "paths": [f"{event.source}/{path}" for path in event.paths[:MAX_PATHS]],
        "more": max(0, len(event.paths) - MAX_PATHS),
        "missed": event.missed,
    }
