"""A writer's side as programs use it: values by path out, what became of them back."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

from shmio.errors import CommandError, ValueRangeError
from shmio.layout.model import Register
from shmio.layout.topic import find
from shmio.layout.write import Write, bit_mask, cover, encode
from shmio.segment.commands import CommandSender
from shmio.segment.events import ENDS, Event, EventKind

if TYPE_CHECKING:
    from shmio.segment.block import Block
    from shmio.segment.cursor import Cursor

TIMEOUT_S: Final = 2.0
"""How long a command may wait for its source, unless told otherwise."""
PATIENCE_S: Final = 1.0
"""What is added for the device's answer to arrive."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one value. ``text``: the reason, if there is one to give."""

    path: str
    kind: EventKind
    text: str = ""

    @property
    def done(self) -> bool:
        """Whether the device confirmed it."""
        return self.kind is EventKind.WRITTEN


@dataclass(slots=True)
class Ticket:
    """A command under way: its number, and where in the events its outcome will be looked for."""

    number: int
    paths: tuple[str, ...]
    owners: tuple[int, ...]
    """For each item of the command the place of its path."""
    incarnation: int
    until_ns: int
    events: Cursor[Event]


class Commander:
    """Writes registers of one block in the name of one writer. Several threads may use it."""

    def __init__(self, block: Block, writer: int) -> None:
        self.block = block
        self._sender = CommandSender(block, writer)

    @cached_property
    def _writable(self) -> bytes:
        return cover(self.block.layout, self.block.attributes.writable)

    def submit(self, values: Mapping[str, object], timeout_s: float = TIMEOUT_S) -> Ticket:
        """Send values of registers, whole arrays or elements by their paths in the block, as one command.

        All or none is accepted by the source. PathError: no such register; CommandError: not writable, or the source
        takes nothing; ValueRangeError: a value does not fit. Nothing has been sent then. Never waits.
        """
        writes: list[Write] = []
        owners: list[int] = []
        for place, (path, value) in enumerate(values.items()):
            register = self._register(path)
            try:
                items = encode(register, value, self.block.layout.byte_order)
            except ValueRangeError as error:
                raise ValueRangeError(f"{self.block.source}/{path}: {error}") from None
            writes += items
            owners += [place] * len(items)
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        events, incarnation = self.block.events.cursor(), self.block.incarnation
        number = self._sender.submit(writes, deadline_ns)
        until_ns = deadline_ns + round(PATIENCE_S * 1e9)
        return Ticket(number, tuple(values), tuple(owners), incarnation, until_ns, events)

    def accepted(self, ticket: Ticket) -> None:
        """Wait until the source has taken the command; CommandError with its reason if it did not."""
        event = self._next(ticket)
        if event is None or event.kind == EventKind.REJECTED:
            raise CommandError(f"{self.block.source}: {event.text if event else self._silence(ticket)}")
        # What follows is read again by outcomes.
        ticket.events = self.block.events.cursor(after=event.number - 1)

    def outcomes(self, ticket: Ticket) -> list[Outcome]:
        """Wait until all is over and say what became of each value, in the order they were given."""
        open_items = set(range(len(ticket.owners)))
        ends: dict[int, Event] = {}
        while open_items and (event := self._next(ticket)) is not None:
            if event.kind == EventKind.REJECTED:
                return [Outcome(path, EventKind.REJECTED, event.text) for path in ticket.paths]
            if event.kind in ENDS:
                ended = open_items.intersection(range(event.item, event.item + event.items))
                open_items -= ended
                ends |= dict.fromkeys(ended, event)
        return [self._outcome(ticket, place, path, ends) for place, path in enumerate(ticket.paths)]

    def write(self, values: Mapping[str, object], timeout_s: float = TIMEOUT_S) -> list[Outcome]:
        """:meth:`submit` and wait for the :meth:`outcomes`."""
        return self.outcomes(self.submit(values, timeout_s))

    def _register(self, path: str) -> Register:
        source = self.block.source
        register = find(self.block.layout, path)
        mask = bit_mask(register, register.offset + register.size)
        for at in range(register.offset, len(mask)):
            if mask[at] & ~self._writable[at]:
                raise CommandError(
                    f"{source}/{path} is not writable; the configuration has to name it in the source's `writable`"
                )
        return register

    def _next(self, ticket: Ticket) -> Event | None:
        """The next event about the command; None when none will come, or not in time."""
        while (rest_ns := ticket.until_ns - time.monotonic_ns()) > 0:
            event = ticket.events.next(rest_ns / 1e9)
            if event is None:
                return None
            if event.command == ticket.number and event.writer == self._sender.writer:
                return event
            if event.kind == EventKind.STARTED and event.incarnation != ticket.incarnation:
                # A successor reports what its predecessor had not taken; of what it had taken nobody knows.
                ticket.until_ns = min(ticket.until_ns, time.monotonic_ns() + round(PATIENCE_S * 1e9))
        return None

    def _outcome(self, ticket: Ticket, place: int, path: str, ends: Mapping[int, Event]) -> Outcome:
        """The worst of a value's items."""
        items = [item for item, owner in enumerate(ticket.owners) if owner == place]
        if any(item not in ends for item in items):
            return Outcome(path, EventKind.UNKNOWN, self._silence(ticket))
        events = [ends[item] for item in items]
        worst = max(events, key=lambda event: (event.kind != EventKind.WRITTEN, event.kind, event.text == ""))
        return Outcome(path, EventKind(worst.kind), worst.text)

    def _silence(self, ticket: Ticket) -> str:
        if self.block.retired:
            return "the source was changed or removed by a reload; it is not known whether the value was written"
        if self.block.incarnation != ticket.incarnation:
            return "the source was restarted meanwhile; it is not known whether the value was written"
        if ticket.events.missed:
            return f"{ticket.events.missed} events were missed, the answer may be among them"
        return "the source gave no answer in time; it is not known whether the value was written"
