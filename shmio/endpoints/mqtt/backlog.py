"""A bounded memory for changes that wait while the broker is away."""

from __future__ import annotations

from collections import deque
from typing import Generic, NamedTuple, TypeVar

Item = TypeVar("Item")


class _Entry(NamedTuple, Generic[Item]):
    number: int
    item: Item
    size: int
    changes: int


class Backlog(Generic[Item]):
    """Items in rows, first in, first out in each; when full, the oldest of all rows is dropped."""

    def __init__(self, most_bytes: int) -> None:
        self.count = 0
        """Number of changes that are kept."""
        self.dropped = 0
        """Number of changes that were dropped because there was no room."""
        self.bytes = 0
        self._most = most_bytes
        self._rows: dict[str, deque[_Entry[Item]]] = {}
        self._number = 0
        """Sequence number of the newest item; older items have lower numbers."""

    def put(self, item: Item, size: int, *, row: str = "", changes: int = 1) -> None:
        """Append the newest item, and drop the oldest ones until everything fits.

        ``size``: in bytes; ``changes``: how many changes the item holds.
        """
        self._number += 1
        self._rows.setdefault(row, deque()).append(_Entry(self._number, item, size, changes))
        self._add(changes, size)
        while self.bytes > self._most:
            oldest = min((kept for kept in self._rows.values() if kept), key=lambda kept: kept[0].number).popleft()
            self._add(-oldest.changes, -oldest.size)
            self.dropped += oldest.changes

    def put_back(self, item: Item, size: int) -> None:
        """Insert an item before all others; drop it if there is no room."""
        if self.bytes + size > self._most:
            self.dropped += 1
            return
        row = self._rows.setdefault("", deque())
        row.appendleft(_Entry(row[0].number - 1 if row else self._number, item, size, 1))
        self._add(1, size)

    def pop(self, row: str = "") -> Item | None:
        """Remove and return the oldest item of a row; None: the row is empty."""
        kept = self._rows.get(row)
        if not kept:
            return None
        oldest = kept.popleft()
        self._add(-oldest.changes, -oldest.size)
        return oldest.item

    def clear(self) -> None:
        """Drop all items, and count them as dropped."""
        self.dropped += self.count
        self.count = self.bytes = 0
        self._rows.clear()

    def _add(self, changes: int, size: int) -> None:
        self.count += changes
        self.bytes += size
