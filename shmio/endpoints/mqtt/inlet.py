"""Commands toward one source: sent as they come, in order, and followed until their end is known."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from shmio.errors import CommandError
from shmio.layout.model import Register
from shmio.segment import DONE, ENDS, Block, Event, EventKind
from shmio.segment.commander import PATIENCE_S, Commander, Ticket
from shmio.segment.events import EVENT_DATA_SIZE

MAX_OPEN: Final = 512
"""Events that may be outstanding: a quarter of the ring, so that none is overwritten before it is read."""
RESTARTED: Final = "the source was restarted meanwhile; it is not known whether the value was written"
RETIRED: Final = "the source was changed or removed by a reload; it is not known whether the value was written"
SILENT: Final = "the source gave no answer in time; it is not known whether the value was written"

Done = Callable[[EventKind, str], None]
"""Called once: what became of a command, and why."""


@dataclass(slots=True)
class _Pending:
    ticket: Ticket
    until_ns: int
    events: int
    done: Done
    taken: bool = False


class Inlet:
    """For the bridge's thread."""

    def __init__(self, block: Block, writer: int) -> None:
        """``writer``: the command queue of this process. For a big layout this takes seconds."""
        self.block = block
        self._writer = writer
        self._commander = Commander(block, writer)
        self._commander.prepare()
        self._pending: dict[int, _Pending] = {}
        self._open_events = 0
        self._events = block.events.cursor()

    @property
    def under_way(self) -> int:
        """Commands whose end is not known."""
        return len(self._pending)

    def send(self, register: Register, value: object, done: Done) -> None:
        """Send a value of a register, an array or an element. CommandError, ValueRangeError: it was not sent."""
        events = 2 + register.size // EVENT_DATA_SIZE
        if self._pending and self._open_events + events > MAX_OPEN:
            raise CommandError(f"{self.block.source}: too many commands are under way; wait for their results")
        if self.block.retired:
            raise CommandError(RETIRED)
        ticket = self._commander.submit({register.path: value})
        self._pending[ticket.number] = _Pending(ticket, ticket.until_ns, events, done)
        self._open_events += events

    def look(self) -> None:
        """Take what has been told; give up what is overdue."""
        retired, missed = self.block.retired, self._events.missed
        while (event := self._events.poll()) is not None:
            if event.kind == EventKind.STARTED:
                self._restarted(event)
            elif event.writer == self._writer and (pending := self._pending.get(event.command)):
                pending.taken = True
                if event.kind in ENDS:
                    self._end(event.command, EventKind(event.kind), event.text)
        if self._events.missed != missed:
            self._hurry()  # their ends may be among what was missed
        if self._pending:
            self._overdue(retired=retired)

    def _overdue(self, *, retired: bool) -> None:
        now_ns = time.monotonic_ns()
        for number in [number for number, one in self._pending.items() if retired or one.until_ns <= now_ns]:
            self._end(number, EventKind.UNKNOWN, RETIRED if retired else SILENT)

    def _restarted(self, event: Event) -> None:
        """A successor rejects what its predecessor had not taken; of what it had taken nobody knows."""
        before = [(n, one) for n, one in self._pending.items() if one.ticket.incarnation != event.incarnation]
        for number, one in before:
            if one.taken:
                self._end(number, EventKind.UNKNOWN, RESTARTED)
        self._hurry()

    def _hurry(self) -> None:
        soon_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
        for one in self._pending.values():
            one.until_ns = min(one.until_ns, soon_ns)

    def _end(self, number: int, kind: EventKind, reason: str) -> None:
        pending = self._pending.pop(number)
        self._open_events -= pending.events
        pending.done(kind, "" if kind in DONE else reason)
