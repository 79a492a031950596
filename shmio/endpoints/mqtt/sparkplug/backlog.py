"""Changes of devices that are kept while the broker is away, within a bound."""

from __future__ import annotations

from typing import Final

from shmio.endpoints.mqtt.outbox import OVERHEAD_BYTES
from shmio.endpoints.mqtt.sparkplug.node import Sample
from shmio.endpoints.mqtt.store import Store

SAMPLE_BYTES: Final = 96
"""Of one in memory, about, beside its value."""
ELEMENT_BYTES: Final = 32
"""Of a number in memory, with its place in a list."""


class Backlog(Store[list[Sample]]):
    """Of each device what its frames brought, in order."""

    def keep(self, device: str, samples: list[Sample]) -> None:
        """Keep what one frame brought."""
        self.put(samples, OVERHEAD_BYTES + sum(map(_size, samples)), row=device, changes=len(samples))

    def take(self, device: str) -> list[Sample]:
        """The oldest of a device; empty: there is nothing."""
        return self.pop(device) or []


def _size(sample: Sample) -> int:
    register = sample.metric.register
    return SAMPLE_BYTES + max(ELEMENT_BYTES * register.count, register.size)
