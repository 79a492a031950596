"""The commands in flight to one source: commands whose outcomes are not known yet."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from shmio.audit.trail import Attempt
from shmio.local.writer import PATIENCE_S, RESTARTED, SILENT, PendingCommand
from shmio.segment import DONE, Event, EventKind
from shmio.segment.commands import CommandOutcomes, End, worst
from shmio.segment.events import EVENT_DATA_SIZE, MAX_BY_BYTES

MAX_OPEN: Final = 512
"""Maximum number of events that all commands in flight may still cause.

The limit is a quarter of the event ring, so that no event is overwritten before it is read.
"""

SUCCESS: Final = DONE | {EventKind.ACCEPTED, EventKind.INJECTED, EventKind.LIFTED, EventKind.NOTED}
"""The outcomes that are a success, for commands of any kind."""
WITHOUT_REASON: Final = frozenset({EventKind.INJECTED, EventKind.LIFTED, EventKind.SHADOWED})
"""Successes whose text is not a reason, but a name or the word of the outcome."""

Done = Callable[[Sequence[End]], None]
"""Function that is called once for each command, with the outcome of each of its values."""


def in_words(end: End) -> str:
    """Return a failed outcome as text: its kind and reason."""
    kind, reason = end
    return f"{kind}: {reason}"


class CommandCost(NamedTuple):
    """Upper bounds of what a command needs: bytes in the command queue, and number of events."""

    record_bytes: int
    events: int

    @classmethod
    def of(cls, sizes: Collection[int], name: str = "") -> CommandCost:
        """Return the cost of a command.

        Args:
            sizes: Size of each item of the command, in bytes.
            name: Name of the injection if the command creates one; else empty.

        """
        events = sum(2 + size // EVENT_DATA_SIZE for size in sizes)
        return cls(80 + MAX_BY_BYTES + 4 * len(name) + sum(24 + size for size in sizes), events)


@dataclass(slots=True)
class InFlightCommand:
    """A command in flight.

    Attributes:
        incarnation: How many times the source's process had been started when the command was sent.
        until_ns: Deadline for the outcomes, in ns of the monotonic clock.
        cost: The queue space and the number of events that the command may need.
        values: For each value, the indices of its items in the command.
        outcomes: The outcomes of the items.
        done: Called once, with the outcome of each value.
        accepted: Called once, if the source accepts the command; None to call nothing.
        attempt: The command's entry in the audit log, which gets the outcome; None if there is
            none.
        paths: The path of each value.

    """

    incarnation: int
    until_ns: int
    cost: CommandCost
    values: Sequence[range]
    outcomes: CommandOutcomes
    done: Done
    accepted: Callable[[], None] | None = None
    attempt: Attempt | None = None
    paths: Sequence[str] = ()
    taken: bool = False
    """True if the source has taken the command from the queue."""
    open_events: int = 0
    """Maximum number of events that the command may still cause."""

    def on_event(self, event: Event) -> bool:
        """Process an event about the command. Return whether all outcomes are known now."""
        if not self.taken and event.kind == EventKind.ACCEPTED and self.accepted is not None:
            self.accepted()
        self.taken = True
        if self.attempt is not None:
            self.attempt.event = event.number
        return self.outcomes.follow(event)

    def finish(self, missing: str = "") -> None:
        """Report the outcomes to :attr:`done` and to the audit log.

        Args:
            missing: Why some outcomes are unknown; empty if all are known.

        """
        ends = [self.outcomes.of(items, missing) for items in self.values]
        if self.attempt is not None:
            kind, reason = worst(ends)
            if len(ends) > 1 and kind not in SUCCESS:
                reason = f"{self.paths[ends.index((kind, reason))]}: {reason}"
            self.attempt.end(str(kind), "" if kind in WITHOUT_REASON else reason, refused=kind not in SUCCESS)
        self.done(ends)


class InFlightTable:
    """The commands in flight of one writer, by command number."""

    def __init__(self, writer: int) -> None:
        self.open_events = 0
        """Maximum number of events that all commands together may still cause."""
        self.untaken_bytes = 0
        """Total size of the commands that may still be in the source's queue, in bytes."""
        self._writer = writer
        self._by_number: dict[int, InFlightCommand] = {}

    def __len__(self) -> int:
        return len(self._by_number)

    def __contains__(self, number: int) -> bool:
        return number in self._by_number

    @property
    def due_ns(self) -> int | None:
        """The earliest deadline of a command, in ns of the monotonic clock; None if no command is in flight."""
        return min((pending.until_ns for pending in self._by_number.values()), default=None)

    def add(
        self,
        ticket: PendingCommand,
        cost: CommandCost,
        done: Done,
        accepted: Callable[[], None] | None = None,
        *,
        attempt: Attempt | None = None,
        until_accepted: bool = False,
    ) -> None:
        """Add a command that was sent.

        Args:
            ticket: The sent command, as the source's writer returned it.
            cost: The queue space and the number of events that the command may need.
            done: Called once, with the outcome of each value.
            accepted: Called once, if the source accepts the command; None to call nothing.
            attempt: The command's entry in the audit log, which gets the outcome; None if there is
                none.
            until_accepted: Whether the acceptance by the source is already the outcome.

        """
        values = ticket.values
        if attempt is not None:
            attempt.command = ticket.number
        self._by_number[ticket.number] = InFlightCommand(
            ticket.incarnation, ticket.until_ns, cost, [items for _, items in values],
            CommandOutcomes(len(ticket.paths), until_accepted=until_accepted), done, accepted, attempt,
            [path for path, _ in values], open_events=cost.events,
        )  # fmt: skip
        self.untaken_bytes += cost.record_bytes
        self.open_events += cost.events

    def on_event(self, event: Event) -> bool:
        """Process an event of the source.

        Returns:
            True if the event is about one of these commands, or is the start of the source.

        """
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
        if pending.on_event(event):
            self._end(event.command)
        return True

    def shorten_timeouts(self) -> None:
        """Shorten all time-outs, because missed events may have contained outcomes."""
        self._shorten(self._by_number.values())

    def expire(self) -> bool:
        """End the commands whose deadline has passed. Their outcomes are unknown.

        Returns:
            True if the source has not yet taken at least one of them from its queue.

        """
        now_ns = time.monotonic_ns()
        overdue = [(number, one) for number, one in self._by_number.items() if one.until_ns <= now_ns]
        for number, _ in overdue:
            self._end(number, SILENT)
        return any(not pending.taken for _, pending in overdue)

    def end(self, reason: str) -> None:
        """End all commands, because no more events will come.

        Args:
            reason: Why their outcomes are unknown.

        """
        for number in list(self._by_number):
            self._end(number, reason)

    def _restarted(self, incarnation: int) -> None:
        """Handle a restart of the source.

        End the commands that its previous process had taken: their outcomes stay unknown. The new
        process rejects the others, so shorten their time-outs.
        """
        before = [(number, one) for number, one in self._by_number.items() if one.incarnation != incarnation]
        for number, pending in before:
            if pending.taken:
                self._end(number, RESTARTED)
        self._shorten(pending for _, pending in before if not pending.taken)

    def _shorten(self, some: Iterable[InFlightCommand]) -> None:
        soon_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
        for pending in some:
            pending.until_ns = min(pending.until_ns, soon_ns)

    def _end(self, number: int, missing: str = "") -> None:
        pending = self._by_number.pop(number)
        self.open_events -= pending.open_events
        if not pending.taken:
            self.untaken_bytes -= pending.cost.record_bytes
        pending.finish(missing)
