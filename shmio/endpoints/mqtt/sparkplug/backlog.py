"""Changes of devices that are kept while the broker is away, within a bound."""

from __future__ import annotations

from collections import deque
from typing import Final

from shmio.endpoints.mqtt.outbox import OVERHEAD_BYTES
from shmio.endpoints.mqtt.sparkplug.node import Sample

SAMPLE_BYTES: Final = 120
"""Of one in memory, about."""


class Backlog:
    """Of each device what it brought, in order."""

    def __init__(self, most_bytes: int) -> None:
        self.count = 0
        """Samples that are kept."""
        self.dropped = 0
        """Those that had no room any more."""
        self._most = most_bytes
        self._bytes = 0
        self._kept: dict[str, deque[list[Sample]]] = {}

    def keep(self, device: str, samples: list[Sample]) -> None:
        """Keep what one frame brought; the oldest of the same device go when there is no room."""
        kept = self._kept.setdefault(device, deque())
        kept.append(samples)
        self._add(samples, 1)
        while self._bytes > self._most and kept:
            oldest = kept.popleft()
            self._add(oldest, -1)
            self.dropped += len(oldest)

    def take(self, device: str) -> list[Sample]:
        """The oldest of a device; empty: there is nothing."""
        kept = self._kept.get(device)
        if not kept:
            return []
        samples = kept.popleft()
        self._add(samples, -1)
        return samples

    def clear(self) -> None:
        """Keep nothing of it; it is dropped."""
        self.dropped += self.count
        self.count = self._bytes = 0
        self._kept.clear()

    def _add(self, samples: list[Sample], sign: int) -> None:
        self.count += sign * len(samples)
        self._bytes += sign * (OVERHEAD_BYTES + SAMPLE_BYTES * len(samples))
