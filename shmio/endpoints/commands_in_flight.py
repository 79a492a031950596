"""The in-flight table: commands to one source whose outcomes are not known yet."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from shmio.local.writer import PATIENCE_S, RESTARTED, SILENT, PendingCommand
from shmio.segment import Event, EventKind
from shmio.segment.commands import CommandOutcomes, End
from shmio.segment.events import EVENT_DATA_SIZE

MAX_OPEN: Final = 512
"""Bound of outstanding events: a quarter of the ring, so that none is overwritten unread."""

Done = Callable[[Sequence[End]], None]
"""Called once, with the outcome of each of a command's values."""


def in_words(end: End) -> str:
    """Return a failed outcome as text."""
    kind, reason = end
    return f"{kind}: {reason}"


class CommandCost(NamedTuple):
    """Upper bounds of what a command needs: bytes in the queue, and events until its end."""

    record_bytes: int
    events: int

    @classmethod
    def of(cls, sizes: Collection[int], name: str = "") -> CommandCost:
        """Return the cost of a command with items of these sizes, in bytes."""
        events = sum(2 + size // EVENT_DATA_SIZE for size in sizes)
        return cls(64 + 4 * len(name) + sum(24 + size for size in sizes), events)


@dataclass(slots=True)
class InFlightCommand:
    """A command in flight.

    Attributes:
        incarnation: The source's process that the command was sent to.
        until_ns: When waiting ends, by the monotonic clock.
        cost: The space it may need.
        values: For each value, the range of its items.
        outcomes: The outcomes of the items.
        done: Called once, with the outcome of each value.
        accepted: Called once, if the source accepts the command.

    """

    incarnation: int
    until_ns: int
    cost: CommandCost
    values: Sequence[range]
    outcomes: CommandOutcomes
    done: Done
    accepted: Callable[[], None] | None = None
    taken: bool = False
    """Whether the source has taken the command out of the queue."""
    open_events: int = 0
    """Upper bound of the events that are still to come."""

    def hear(self, event: Event) -> bool:
        """Process one event; return whether all outcomes are known."""
        if not self.taken and event.kind == EventKind.ACCEPTED and self.accepted is not None:
            self.accepted()
        self.taken = True
        return self.outcomes.follow(event)

    def finish(self, missing: str = "") -> None:
        """Report the outcomes. ``missing``: why some of them are unknown."""
        self.done([self.outcomes.of(items, missing) for items in self.values])


class InFlightTable:
    """The commands of one writer that are in flight, by number."""

    def __init__(self, writer: int) -> None:
        self.open_events = 0
        """Upper bound of the events that are still to come."""
        self.untaken_bytes = 0
        """Size of the records that may still be in the queue."""
        self._writer = writer
        self._by_number: dict[int, InFlightCommand] = {}

    def __len__(self) -> int:
        return len(self._by_number)

    @property
    def due_ns(self) -> int | None:
        """When waiting for the first command ends, by the monotonic clock; None: there is none."""
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
        """Add a command that was sent.

        Arguments as of :class:`InFlightCommand` and :class:`CommandOutcomes`.
        """
        self._by_number[ticket.number] = InFlightCommand(
            ticket.incarnation, ticket.until_ns, cost, [items for _, items in ticket.values],
            CommandOutcomes(len(ticket.paths), until_accepted=until_accepted), done, accepted, open_events=cost.events,
        )  # fmt: skip
        self.untaken_bytes += cost.record_bytes
        self.open_events += cost.events

    def hear(self, event: Event) -> bool:
        """Process an event; return whether it concerns these commands or the source's start."""
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
        """Shorten all time-outs, because the awaited events may be among missed ones."""
        self._hurry(self._by_number.values())

    def expire(self) -> bool:
        """End the overdue commands; return whether the source has not even taken one of them."""
        now_ns = time.monotonic_ns()
        overdue = [(number, one) for number, one in self._by_number.items() if one.until_ns <= now_ns]
        for number, _ in overdue:
            self._end(number, SILENT)
        return any(not pending.taken for _, pending in overdue)

    def end(self, reason: str) -> None:
        """End all commands, because no more events will come."""
        for number in list(self._by_number):
            self._end(number, reason)

    def _restarted(self, incarnation: int) -> None:
        """End the commands that the source's previous process had taken: their outcome is unknown.

        The new process rejects those that were not taken, so these only get a short time-out.
        """
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
