"""A command whose end has not come yet."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from shmio.segment import DONE, ENDS, Event, EventKind
from shmio.segment.events import EVENT_DATA_SIZE

End = tuple[EventKind, str]
"""What became of an item, one of ``ENDS`` or, if that is waited for, ACCEPTED; and the reason, if there is one."""
Done = Callable[[Sequence[End]], None]
"""Called once with the ends of a command's items."""


def worst(ends: Sequence[End]) -> End:
    """One end for all: the first that is not what was wanted, its reason in words."""
    kind, reason = next((end for end in ends if end[0] not in DONE), ends[0])
    return kind, "" if kind in DONE else f"{kind}: {reason}"


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
    """``items``: how many it has; ``accepted``: called once, if the source accepts it.

    ``until_accepted``: to be accepted is the end.
    """

    incarnation: int
    until_ns: int
    cost: Cost
    items: int
    done: Done
    accepted: Callable[[], None] | None = None
    until_accepted: bool = False
    taken: bool = False
    """Whether the source has it, out of the queue."""
    open_events: int = 0
    """At most so many are still to come."""
    _ends: dict[int, End] = field(default_factory=dict)

    def hear(self, event: Event) -> bool:
        """Take in what an event says; whether the end of all is known by now."""
        if not self.taken and event.kind == EventKind.ACCEPTED and self.accepted is not None:
            self.accepted()
        self.taken = True
        if event.kind == EventKind.REJECTED:
            self._ends = dict.fromkeys(range(self.items), (EventKind.REJECTED, event.text))
        elif event.kind in ENDS or (self.until_accepted and event.kind == EventKind.ACCEPTED):
            kind = EventKind(event.kind)
            end = kind, event.text if kind is not EventKind.ACCEPTED else ""
            for item in range(event.item, min(event.item + max(1, event.items), self.items)):
                self._ends[item] = end
        return len(self._ends) == self.items

    def finish(self, missing: str = "") -> None:
        """Tell the ends; ``missing``: why that of some items is not known."""
        unknown = EventKind.UNKNOWN, missing
        self.done([self._ends.get(item, unknown) for item in range(self.items)])
