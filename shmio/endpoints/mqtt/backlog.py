"""What is kept while the broker is away, within a bound of bytes."""

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
    """Rows of items, each in its order; the oldest, of whatever row, go when there is no room."""

    def __init__(self, most_bytes: int) -> None:
        self.count = 0
        """Changes that are kept."""
        self.dropped = 0
        """Those that had no room."""
        self.bytes = 0
        self._most = most_bytes
        self._rows: dict[str, deque[_Entry[Item]]] = {}
        self._number = 0
        """Of the newest; who has a lower one is older."""

    def put(self, item: Item, size: int, *, row: str = "", changes: int = 1) -> None:
        """Keep one that is newer than all others. ``size``: in bytes; ``changes``: how many it tells."""
        self._number += 1
        self._rows.setdefault(row, deque()).append(_Entry(self._number, item, size, changes))
        self._add(changes, size)
        while self.bytes > self._most:
            oldest = min((kept for kept in self._rows.values() if kept), key=lambda kept: kept[0].number).popleft()
            self._add(-oldest.changes, -oldest.size)
            self.dropped += oldest.changes

    def put_back(self, item: Item, size: int) -> None:
        """Keep one that is older than all others, if there is room."""
        if self.bytes + size > self._most:
            self.dropped += 1
            return
        row = self._rows.setdefault("", deque())
        row.appendleft(_Entry(row[0].number - 1 if row else self._number, item, size, 1))
        self._add(1, size)

    def pop(self, row: str = "") -> Item | None:
        """The oldest of a row; None: there is nothing."""
        kept = self._rows.get(row)
        if not kept:
            return None
        oldest = kept.popleft()
        self._add(-oldest.changes, -oldest.size)
        return oldest.item

    def clear(self) -> None:
        """Keep nothing of it; it is dropped."""
        self.dropped += self.count
        self.count = self.bytes = 0
        self._rows.clear()

    def _add(self, changes: int, size: int) -> None:
        self.count += changes
        self.bytes += size
