"""Commands toward one source whose end has not come yet."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from shmio.local.writer import PATIENCE_S, RESTARTED, SILENT, PendingCommand
from shmio.segment import DONE, ENDS, Event, EventKind
from shmio.segment.events import EVENT_DATA_SIZE

MAX_OPEN: Final = 512
"""Events that may be outstanding: a quarter of the ring, so that none is overwritten before it is read."""

End = tuple[EventKind, str]
"""What became of an item, one of ``ENDS`` or, if that is waited for, ACCEPTED; and the reason, if there is one."""
Done = Callable[[Sequence[End]], None]
"""Called once with the ends of a command's values."""


def worst(ends: Sequence[End]) -> End:
    """One end for all: the first that is not what was wanted."""
    return next((end for end in ends if end[0] not in DONE), ends[0])


def in_words(end: End) -> str:
    """What became of one that is not what was wanted."""
    kind, reason = end
    return f"{kind}: {reason}"


class CommandCost(NamedTuple):
    """At most so many bytes in the queue, and events until its end, has a command."""

    record_bytes: int
    events: int

    @classmethod
    def of(cls, sizes: Collection[int], name: str = "") -> CommandCost:
        """That of one with items of so many bytes."""
        events = sum(2 + size // EVENT_DATA_SIZE for size in sizes)
        return cls(64 + 4 * len(name) + sum(24 + size for size in sizes), events)


@dataclass(slots=True)
class InFlightCommand:
    """``values``: the items of each of its values; ``accepted``: called once, if the source accepts it.

    ``until_accepted``: to be accepted is the end.
    """

    incarnation: int
    until_ns: int
    cost: CommandCost
    values: Sequence[range]
    done: Done
    accepted: Callable[[], None] | None = None
    until_accepted: bool = False
    taken: bool = False
    """Whether the source has it, out of the queue."""
    open_events: int = 0
    """At most so many are still to come."""
    _ends: dict[int, End] = field(default_factory=dict)

    @property
    def items(self) -> int:
        """How many it has."""
        return self.values[-1].stop

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
        self.done([worst([self._ends.get(item, unknown) for item in items]) for items in self.values])


class InFlightTable:
    """Those of one writer, by their numbers."""

    def __init__(self, writer: int) -> None:
        self.open_events = 0
        """At most so many are still to come."""
        self.untaken_bytes = 0
        """Of records that may still lie in the queue."""
        self._writer = writer
        self._by_number: dict[int, InFlightCommand] = {}

    def __len__(self) -> int:
        return len(self._by_number)

    @property
    def due_ns(self) -> int | None:
        """When the first one is not waited for any more; None: there is none."""
        return min((pending.until_ns for pending in self._by_number.values()), default=None)

    def add(
        self,
        ticket: PendingCommand,
        cost: CommandCost,
        done: Done,
        accepted: Callable[[], None] | None = None,
        *,
        until_accepted: bool = False,
    ) -> None:
        """Follow one that was sent."""
        self._by_number[ticket.number] = InFlightCommand(
            ticket.incarnation, ticket.until_ns, cost, [items for _, items in ticket.values], done, accepted,
            until_accepted, open_events=cost.events,
        )  # fmt: skip
        self.untaken_bytes += cost.record_bytes
        self.open_events += cost.events

    def hear(self, event: Event) -> bool:
        """Take in what the source says; whether it says anything of these, or that it has started."""
        if event.kind == EventKind.STARTED:
            self._restarted(event.incarnation)
            return True
        pending = self._by_number.get(event.command) if event.writer == self._writer else None
        if pending is None:
            return False
        if not pending.taken:
            self.untaken_bytes -= pending.cost.record_bytes
        if pending.open_events:
            pending.open_events -= 1
            self.open_events -= 1
        if pending.hear(event):
            self._end(event.command)
        return True

    def hurry(self) -> None:
        """Wait no longer than it takes to come: the ends may be among what was missed."""
        self._hurry(self._by_number.values())

    def expire(self) -> bool:
        """Give up what is overdue; whether there is one among it that the source has not even taken."""
        now_ns = time.monotonic_ns()
        overdue = [(number, one) for number, one in self._by_number.items() if one.until_ns <= now_ns]
        for number, _ in overdue:
            self._end(number, SILENT)
        return any(not pending.taken for _, pending in overdue)

    def end(self, reason: str) -> None:
        """Nothing more is heard of any of them."""
        for number in list(self._by_number):
            self._end(number, reason)

    def _restarted(self, incarnation: int) -> None:
        """A successor rejects what its predecessor had not taken; of what it had taken nobody knows."""
        before = [(number, one) for number, one in self._by_number.items() if one.incarnation != incarnation]
        for number, pending in before:
            if pending.taken:
                self._end(number, RESTARTED)
        self._hurry(pending for _, pending in before if not pending.taken)

    def _hurry(self, some: Iterable[InFlightCommand]) -> None:
        soon_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
        for pending in some:
            pending.until_ns = min(pending.until_ns, soon_ns)

    def _end(self, number: int, missing: str = "") -> None:
        pending = self._by_number.pop(number)
        self.open_events -= pending.open_events
        if not pending.taken:
            self.untaken_bytes -= pending.cost.record_bytes
        pending.finish(missing)
