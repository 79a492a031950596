"""Sends clients' commands to one source, and waits for their outcomes."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Final

from shmio.audit.trail import Attempt
from shmio.endpoints.commands_in_flight import MAX_OPEN, CommandCost, InFlightTable
from shmio.errors import CommandError
from shmio.layout.model import Register
from shmio.layout.values.write import sizes
from shmio.local.writer import REPLACED, RETIRED, PendingCommand, SourceWriter
from shmio.segment import Block
from shmio.segment.commands import End, worst

ROOM_S: Final = 2.0
"""Maximum time in s for which a command waits because too many commands are in flight."""


class CommandClient:
    """Sends commands to one source. Once it is created, use it only in the event loop's thread."""

    def __init__(self, block: Block, writer: int) -> None:
        """Prepare to send commands. For a large layout this takes seconds."""
        self.block = block
        self._source_writer = SourceWriter(block, writer)
        self._source_writer.prepare()
        self._in_flight = InFlightTable(writer)
        self._events = block.events.cursor()
        self._room = asyncio.Event()

    def is_writable(self, register: Register) -> bool:
        """Return whether the configuration allows clients to write all of a register, element or part."""
        return self._source_writer.is_writable(register)

    async def write(self, values: Mapping[Register, object], attempt: Attempt | None = None) -> End:
        """Write values as one command, wait for the outcome, and return the outcome.

        Args:
            values: The value of each register, element or part.
            attempt: The command's entry in the audit log; None if there is none.

        Raises:
            CommandError: The command was not sent.
            ValueRangeError: A value does not fit its register. The command was not sent.

        """
        cost = CommandCost.of([size for register in values for size in sizes(register)])
        await self._await_room(cost)
        by_path = {register.path: value for register, value in values.items()}
        return await self._sent(self._source_writer.submit(by_path), cost, attempt)

    async def lift(self, injection: int) -> End:
        """Lift an injection, and return the outcome.

        Raises:
            CommandError: The command was not sent.
        """
        cost = CommandCost.of(())
        with Attempt("lift", {"source": self.block.source, "injection": injection}) as attempt:
            await self._await_room(cost)
            return await self._sent(self._source_writer.ask_to_lift(injection), cost, attempt)

    async def _await_room(self, cost: CommandCost) -> None:
        try:
            async with asyncio.timeout(ROOM_S):
                while self._in_flight and self._in_flight.open_events + cost.events > MAX_OPEN:
                    self._room.clear()
                    await self._room.wait()
        except TimeoutError:
            raise CommandError(
                f"{self.block.source}: too many commands are in flight; wait for their results"
            ) from None
        if self.block.retired:
            raise CommandError(RETIRED)

    async def _sent(self, command: PendingCommand, cost: CommandCost, attempt: Attempt | None) -> End:
        answer: asyncio.Future[Sequence[End]] = asyncio.get_running_loop().create_future()

        def done(ends: Sequence[End]) -> None:
            if not answer.done():
                answer.set_result(ends)

        self._in_flight.add(command, cost, done, attempt=attempt)
        return worst(await answer)

    def poll(self) -> None:
        """Read new events, and complete the commands whose outcome is known or overdue."""
        while (event := self._events.poll()) is not None:
            self._in_flight.on_event(event)
        if self._events.take_missed():
            self._in_flight.shorten_timeouts()
        self._in_flight.expire()
        if self._events.ended:
            self._in_flight.end(REPLACED)
        self._room.set()
