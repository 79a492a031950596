"""Commands to one block for clients of shmio.v1, and what its source says of them, item by item."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol, Unpack

from shmio.endpoints.grpc.bells import Bells
from shmio.errors import CommandError
from shmio.layout.model import Register
from shmio.layout.write import bits_of
from shmio.segment import ENDS, Block, Event, EventKind
from shmio.segment.commander import PATIENCE_S, Commander, Ticket
from shmio.segment.commands import Laid
from shmio.segment.diverted import Diverted, Gatherer

MAX_OPEN: Final = 64
"""Commands under way at once; who comes then waits."""
BATCH: Final = 256
"""Events that are looked at before others have a turn."""

End = tuple[EventKind, str]
"""What became of an item, one of ``ENDS`` or ACCEPTED, and the reason if there is one to give."""


class Follower(Protocol):
    """Who has laid an injection."""

    def divert(self, diverted: Diverted) -> None:
        """A command's values went to it."""

    def restack(self) -> None:
        """An injection was laid or lifted, on the same source."""

    def lifted(self, reason: str) -> None:
        """It was lifted."""


@dataclass(slots=True)
class _Pending:
    ticket: Ticket
    until_accepted: bool
    done: asyncio.Future[list[End]]
    ends: dict[int, End] = field(default_factory=dict)

    @property
    def items(self) -> int:
        return len(self.ticket.paths)

    def finish(self, missing: str = "") -> None:
        if not self.done.done():
            unknown = EventKind.UNKNOWN, missing
            self.done.set_result([self.ends.get(place, unknown) for place in range(self.items)])


class Desk:
    """Sends commands in order and hears of their ends. For the event loop's thread.

    It follows the block's events only while something is open. Its commands go by the queue of this process, like
    those of the block's inlet, which is of the same thread.
    """

    def __init__(self, block: Block, writer: int, bells: Bells) -> None:
        """``writer``: the command queue of this process."""
        self.block = block
        self._writer = writer
        self._bells = bells
        self._commander = Commander(block, writer)
        self._prepared: asyncio.Task[None] | None = None
        self._room = asyncio.Semaphore(MAX_OPEN)
        self._pending: dict[int, _Pending] = {}
        self._followers: dict[int, Follower] = {}
        self._gatherer = Gatherer()
        self._cursor = block.events.cursor()
        self._following = False
        self._loop = asyncio.get_running_loop()

    async def write(
        self, values: Mapping[str, object], timeout_s: float | None, *, until_accepted: bool = False
    ) -> list[End]:
        """Write values by path, as one command; what became of each.

        PathError, ValueRangeError; CommandError: not writable, or the source takes nothing. Nothing has been sent then.
        """
        if self._prepared is None:  # not on the loop: for a large layout it takes seconds
            self._prepared = self._loop.create_task(asyncio.to_thread(self._commander.prepare))
        await asyncio.shield(self._prepared)
        return await self._send(lambda: self._commander.submit(values, timeout_s), until_accepted=until_accepted)

    async def give(self, injection: int, values: Mapping[str, object]) -> list[End]:
        """Give values by path as an injection's; what became of them, of neighbours in one. Errors as of write."""
        return await self._send(lambda: self._commander.give(injection, values))

    async def lay(self, registers: Iterable[Register], follower: Follower, **laid: Unpack[Laid]) -> int:
        """Lay an injection; its number. CommandError: the source refuses it, or does not answer."""
        bits = bytearray(self.block.layout.size)
        for register in registers:
            for at, own in enumerate(bits_of(register), register.offset):
                bits[at] |= own
        number = 0

        def submit() -> Ticket:
            nonlocal number
            ticket = self._commander.lay(bytes(bits), **laid)
            number = ticket.number
            self._followers[number] = follower
            return ticket

        ((kind, reason),) = await self._send(submit)
        if kind is not EventKind.INJECTED:
            self._followers.pop(number, None)
            self._look()
            if kind is EventKind.UNKNOWN:  # it may stand
                await self.lift(number)
            raise CommandError(f"{self.block.source}: {reason}")
        return number

    async def lift(self, injection: int) -> str:
        """Lift an injection; why it still stands, or empty."""
        try:
            ((_, reason),) = await self._send(lambda: self._commander.ask_to_lift(injection))
        except CommandError as error:
            reason = str(error)
        stands = any(one.id == injection for one in self.block.standing.read())
        return (reason or "the source has not lifted it yet") if stands and not self.block.retired else ""

    def forget(self, injection: int) -> None:
        """Tell the follower of an injection nothing more."""
        self._followers.pop(injection, None)
        self._look()

    async def _send(self, submit: Callable[[], Ticket], *, until_accepted: bool = False) -> list[End]:
        async with self._room:
            if self.block.retired:
                raise CommandError("the source was changed or removed by a reload")
            self._follow()
            ticket = submit()
            pending = self._pending[ticket.number] = _Pending(ticket, until_accepted, self._loop.create_future())
            try:
                return await self._end_of(pending)
            finally:
                del self._pending[ticket.number]
                self._look()

    async def _end_of(self, pending: _Pending) -> list[End]:
        while not pending.done.done():
            rest_s = (pending.ticket.until_ns - time.monotonic_ns()) / 1e9
            if rest_s <= 0 or self.block.retired:
                reason = "was changed or removed by a reload" if self.block.retired else "gave no answer in time"
                pending.finish(f"the source {reason}; it is not known whether it was done")
                break
            await asyncio.wait((pending.done,), timeout=min(rest_s, 1.0))
        return pending.done.result()

    # ---- what the source says ------------------------------------------------------------------------------------

    def _follow(self) -> None:
        """Begin to follow the events, from now on."""
        if not self._following:
            self._following = True
            self._cursor = self.block.events.cursor()
            self._gatherer = Gatherer()
            self._bells.join(self.block, self._hear)

    def _look(self) -> None:
        """Follow them no more when nothing is open."""
        if self._following and not self._pending and not self._followers:
            self._following = False
            self._bells.leave(self.block, self._hear)

    def _hear(self) -> None:
        missed = self._cursor.missed
        for _ in range(BATCH):
            event = self._cursor.poll()
            if event is None:
                break
            self._heed(event)
        else:
            self._loop.call_soon(self._hear)
        if self._cursor.missed != missed:
            for pending in list(self._pending.values()):
                pending.finish(f"{self._cursor.missed - missed} events were missed, the answer may be among them")
        if self.block.retired and self._cursor.behind == 0:
            followers, self._followers = self._followers, {}
            for follower in followers.values():
                follower.lifted("the source was changed or removed by a reload")

    def _heed(self, event: Event) -> None:
        for diverted in self._gatherer.follow(event):
            if follower := self._followers.get(diverted.injection):
                follower.divert(diverted)
        if event.kind == EventKind.STARTED:
            soon_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
            for pending in self._pending.values():  # a successor rejects what its predecessor had not taken
                if pending.ticket.incarnation != event.incarnation:
                    pending.ticket.until_ns = min(pending.ticket.until_ns, soon_ns)
        elif event.writer == self._writer and (found := self._pending.get(event.command)):
            self._heed_own(event, found)
        if event.kind == EventKind.LIFTED and (gone := self._followers.pop(event.injection, None)):
            gone.lifted(event.text)
        if event.kind in (EventKind.INJECTED, EventKind.LIFTED):
            for follower in list(self._followers.values()):
                follower.restack()

    def _heed_own(self, event: Event, pending: _Pending) -> None:
        kind = EventKind(event.kind)
        if kind is EventKind.REJECTED:
            pending.ends = dict.fromkeys(range(pending.items), (kind, event.text))
        elif kind in ENDS or (pending.until_accepted and kind is EventKind.ACCEPTED):
            items = range(event.item, min(event.item + max(1, event.items), pending.items))
            pending.ends |= dict.fromkeys(items, (kind, event.text if kind is not EventKind.ACCEPTED else ""))
        if len(pending.ends) == pending.items:
            pending.finish()
