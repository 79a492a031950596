"""How much waits for clients: in one stream, and in all of them."""

from __future__ import annotations

from collections.abc import Sized
from typing import Final

BOUND_BYTES: Final = 8 << 20
"""Of values, and of events, that wait in a stream."""
TOTAL_BYTES: Final = 256 << 20
"""Of all that waits in all streams: when there is more, a stream may hold no more than its equal part of it."""


class Total:
    """What waits in all streams."""

    def __init__(self) -> None:
        self.size = 0
        self.streams = 0

    def over(self, size: int) -> bool:
        """Whether there is too much of it, and a stream that holds so much has a part in that."""
        return self.size > TOTAL_BYTES and size > TOTAL_BYTES // max(1, self.streams)


class Load:
    """Messages of one kind that wait."""

    def __init__(self, total: Total) -> None:
        self.count = 0
        self.size = 0
        self._total = total

    def full(self, message: Sized, bound: int, bound_bytes: int | None = None) -> bool:
        """Whether one more would be too much. A single one never is, however long."""
        most = BOUND_BYTES if bound_bytes is None else bound_bytes
        size = self.size + len(message)
        return self.count > 0 and (self.count >= bound or size > most or self._total.over(size))

    def add(self, message: Sized) -> None:
        """One waits."""
        size = len(message)
        self.count += 1
        self.size += size
        self._total.size += size

    def remove(self, message: Sized) -> None:
        """It waits no more."""
        size = len(message)
        self.count -= 1
        self.size -= size
        self._total.size -= size
