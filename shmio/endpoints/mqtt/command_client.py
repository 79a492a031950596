"""Sends commands to one source, and follows each until its outcome is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from shmio.endpoints.in_flight import MAX_OPEN, CommandCost, InFlightTable
from shmio.errors import CommandError
from shmio.layout.model import Register
from shmio.layout.values.write import sizes
from shmio.local.writer import REPLACED, RETIRED, SourceWriter
from shmio.segment import DONE, Block, EventKind
from shmio.segment.commands import End, worst

Done = Callable[[EventKind, str], None]
"""Called once for each command, with its outcome and the reason."""


class CommandClient:
    """Sends commands to one source. Use it from the bridge's thread."""

    def __init__(self, block: Block, writer: int) -> None:
        """``writer``: number of this process's command queue.

        For a large layout this takes seconds.
        """
        self.block = block
        self._source_writer = SourceWriter(block, writer)
        self._source_writer.prepare()
        self._pending = InFlightTable(writer)
        self._events = block.events.cursor()

    def check(self, register: Register) -> None:
        """Check that a register is writable.

        Raises:
            CommandError: The register is not writable.

        """
        self._source_writer.check(register)

    def send(self, register: Register, value: object, done: Done) -> None:
        """Send a value for a register, an array or an element.

        ``done`` is called once with the outcome.

        Raises:
            CommandError: The command was not sent.
            ValueRangeError: The value does not fit; the command was not sent.

        """
        cost = CommandCost.of(sizes(register))
        if self._pending and self._pending.open_events + cost.events > MAX_OPEN:
            raise CommandError(f"{self.block.source}: too many commands are under way; wait for their results")
        if self.block.retired:
            raise CommandError(RETIRED)
        self._pending.add(self._source_writer.submit({register.path: value}), cost, partial(_tell, done))

    def poll(self) -> None:
        """Read new events, and end the commands whose outcome is known or overdue."""
        while (event := self._events.poll()) is not None:
            self._pending.hear(event)
        if self._events.take_missed():
            self._pending.hurry()
        self._pending.expire()
        if self._events.ended:
            self._pending.end(REPLACED)


def _tell(done: Done, ends: Sequence[End]) -> None:
    kind, reason = worst(ends)
    done(kind, "" if kind in DONE else reason)
