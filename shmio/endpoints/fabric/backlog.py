"""Keeps the newest messages of all sources in a memory of limited size."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final

from shmio.fabric.names import CellName

OVERHEAD_BYTES: Final = 200
"""What a message needs besides its bytes."""


class Kept:
    """A message in the backlog.

    Attributes:
        number: Number of the message.
        data: The encoded message.
        made_ns: CLOCK_MONOTONIC at which it was made.
        sent: True if it was sent on the present connection.
        confirmed: True if the server has it.

    """

    __slots__ = ("confirmed", "data", "made_ns", "number", "sent")

    def __init__(self, number: int, data: bytearray, made_ns: int) -> None:
        self.number = number
        self.data = data
        self.made_ns = made_ns
        self.sent = self.confirmed = False

    @property
    def size(self) -> int:
        """The memory that the message needs, in bytes."""
        return OVERHEAD_BYTES + len(self.data)


class Row:
    """The messages of one source.

    ``next`` is the number of the next message for ``.live``. ``late`` are the numbers of earlier
    messages that wait for ``.late``.
    """

    def __init__(self, cell: CellName, source: str, stream: int) -> None:
        self.source = source
        self.stream = stream
        self.live, self.late_subject = cell.live(source), cell.late(source)
        self.last = 0
        """Number of the newest message."""
        self.left_out = 0
        """Number of frames that a rule has left out before the last frame of the newest message."""
        self.next = 1
        self.late: deque[int] = deque()
        self._kept: deque[Kept] = deque()

    def append(self, message: Kept) -> None:
        """Append the newest message."""
        self.last = message.number
        self._kept.append(message)

    @property
    def oldest(self) -> Kept | None:
        """The oldest message that is kept."""
        return self._kept[0] if self._kept else None

    @property
    def droppable(self) -> bool:
        """True if there are several messages. The newest is never dropped: it shows the present state."""
        return len(self._kept) > 1

    def drop(self) -> Kept:
        """Remove and return the oldest message."""
        return self._kept.popleft()

    def find(self, number: int) -> Kept | None:
        """Return the message with a number; None if it is not kept."""
        if not self._kept:
            return None
        at = number - self._kept[0].number
        return self._kept[at] if 0 <= at < len(self._kept) else None

    def between(self, first: int, last: int) -> Iterator[int]:
        """Yield the numbers of the kept messages in a range."""
        if self._kept:
            yield from range(max(first, self._kept[0].number), min(last, self.last) + 1)

    def skip(self) -> None:
        """Make the newest message the next one for ``.live``; send those before it as late."""
        self.late.extend(self.between(self.next, self.last - 1))
        self.next = max(self.next, self.last)

    def resend(self, numbers: Iterable[int]) -> None:
        """Send messages again, as late."""
        self.late = deque(sorted({*self.late, *numbers}))

    def begin_again(self) -> None:
        """After a lost connection, send all messages again that the server has not confirmed.

        The newest is the next one for ``.live``.
        """
        for one in self._kept:
            one.sent = one.confirmed
        unconfirmed = [one.number for one in self._kept if not one.confirmed]
        self.next = self.last + 1
        if unconfirmed and unconfirmed[-1] == self.last:
            self.next = unconfirmed.pop()
        self.late = deque(unconfirmed)

    @property
    def waiting(self) -> int:
        """Number of messages that wait to be sent."""
        return len(self.late) + self.last + 1 - self.next


class Backlog:
    """The rows of all sources. If they need too much memory, the oldest message of all rows is dropped."""

    def __init__(self, most_bytes: int, *, until_confirmed: bool = False) -> None:
        """Create the backlog.

        Args:
            most_bytes: Maximum size.
            until_confirmed: Whether a message that was sent and is not confirmed counts as dropped.

        """
        self.rows: dict[str, Row] = {}
        self.bytes = 0
        self.dropped = 0
        """Number of messages that were dropped before the server had them."""
        self._most = most_bytes
        self._until_confirmed = until_confirmed

    def put(self, row: Row, message: Kept) -> None:
        """Append a message to a row, and drop the oldest messages until the rest fits."""
        row.append(message)
        self.bytes += message.size
        while self.bytes > self._most and (rows := [one for one in self.rows.values() if one.droppable]):
            dropped = min(rows, key=_made).drop()
            self.bytes -= dropped.size
            self.dropped += not (dropped.confirmed or (dropped.sent and not self._until_confirmed))

    def remove(self, source: str) -> None:
        """Remove the row of a source."""
        row = self.rows.pop(source)
        while row.oldest is not None:
            self.bytes -= row.drop().size

    @property
    def waiting(self) -> int:
        """Number of messages that wait to be sent."""
        return sum(row.waiting for row in self.rows.values())


def _made(row: Row) -> int:
    return row.oldest.made_ns if row.oldest else 0
