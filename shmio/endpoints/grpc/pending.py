"""A command whose end has not come yet."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple

from shmio.segment import DONE, ENDS, Event, EventKind
from shmio.segment.events import EVENT_DATA_SIZE

End = tuple[EventKind, str]
"""What became of it, one of ``ENDS``, and the reason if it did not get where it was to."""
Done = Callable[[EventKind, str], None]
"""Called once with a command's end."""


class Cost(NamedTuple):
    """At most so many bytes in the queue, and events until its end, has a command."""

    record_bytes: int
    events: int

    @classmethod
    def of(cls, sizes: Collection[int], name: str = "") -> Cost:
        """That of one with items of so many bytes."""
        events = sum(2 + size // EVENT_DATA_SIZE for size in sizes)
        return cls(64 + 4 * len(name) + sum(24 + size for size in sizes), events)


@dataclass(slots=True)
class Pending:
    """``open``: its items of which nothing is known; ``accepted``: called once, if the source accepts it."""

    incarnation: int
    until_ns: int
    cost: Cost
    open: set[int]
    done: Done
    accepted: Callable[[], None] | None = None
    taken: bool = False
    """Whether the source has it, out of the queue."""
    _end: End | None = None

    def hear(self, event: Event) -> End | None:
        """What an event says of it; its end, if that is the last one. That of several items is the worst."""
        if not self.taken and event.kind == EventKind.ACCEPTED and self.accepted is not None:
            self.accepted()
        self.taken = True
        if event.kind not in ENDS:
            return None
        self.open.difference_update(range(event.item, event.item + max(1, event.items)))
        if self._end is None or self._end[0] in DONE:
            kind = EventKind(event.kind)
            self._end = kind, "" if kind in DONE else f"{kind}: {event.text}"
        return None if self.open else self._end
