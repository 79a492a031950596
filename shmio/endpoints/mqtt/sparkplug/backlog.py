"""Changes of devices that are kept while the broker is away, within a bound."""

from __future__ import annotations

from collections import deque
from typing import Final

from shmio.endpoints.mqtt.outbox import OVERHEAD_BYTES
from shmio.endpoints.mqtt.sparkplug.node import Sample

SAMPLE_BYTES: Final = 96
"""Of one in memory, about, beside its value."""
ELEMENT_BYTES: Final = 32
"""Of a number in memory, with its place in a list."""


class Backlog:
    """Of each device what it brought, in order."""

    def __init__(self, most_bytes: int) -> None:
        self.count = 0
        """Samples that are kept."""
        self.dropped = 0
        """Those that had no room any more."""
        self._most = most_bytes
        self._bytes = 0
        self._kept: dict[str, deque[tuple[int, list[Sample]]]] = {}
        self._number = 0

    def keep(self, device: str, samples: list[Sample]) -> None:
        """Keep what one frame brought; the oldest, of whatever device, go when there is no room."""
        self._number += 1
        self._kept.setdefault(device, deque()).append((self._number, samples))
        self._add(samples, 1)
        while self._bytes > self._most:
            _, oldest = min((kept for kept in self._kept.values() if kept), key=lambda kept: kept[0][0]).popleft()
            self._add(oldest, -1)
            self.dropped += len(oldest)

    def take(self, device: str) -> list[Sample]:
        """The oldest of a device; empty: there is nothing."""
        kept = self._kept.get(device)
        if not kept:
            return []
        _, samples = kept.popleft()
        self._add(samples, -1)
        return samples

    def clear(self) -> None:
        """Keep nothing of it; it is dropped."""
        self.dropped += self.count
        self.count = self._bytes = 0
        self._kept.clear()

    def _add(self, samples: list[Sample], sign: int) -> None:
        self.count += sign * len(samples)
        self._bytes += sign * (OVERHEAD_BYTES + sum(map(_size, samples)))


def _size(sample: Sample) -> int:
    register = sample.metric.register
    return SAMPLE_BYTES + max(ELEMENT_BYTES * register.count, register.size)
