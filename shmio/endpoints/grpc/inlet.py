"""The way into one block: sends values, follows the block's events, and tells what became of each."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import Final, Unpack

from shmio.endpoints.grpc.bells import Bells
from shmio.endpoints.grpc.echo import Echo
from shmio.endpoints.grpc.followers import Follower, Followers
from shmio.endpoints.grpc.pending import Cost, Done, Pending
from shmio.errors import CommandError
from shmio.layout.model import Register
from shmio.layout.topic import find
from shmio.layout.write import bits_of
from shmio.segment import Block, Event, EventKind
from shmio.segment.commander import PATIENCE_S, Commander, Ticket
from shmio.segment.commands import Laid

log = logging.getLogger("shmio.grpc")

MAX_OPEN: Final = 512
"""Events that may be outstanding: a quarter of the ring, so that none is overwritten before it is read."""
BATCH: Final = 32
"""Most events that are looked at at once, so that streams get their turn in between."""

_RETIRED: Final = "the source was changed or removed by a reload"


class Inlet:
    """Sends values to a block's source, in order, and keeps no more under way than it can hear the end of.

    For the event loop's thread.
    """

    def __init__(
        self,
        block: Block,
        writer: int,
        bells: Bells,
        stamp: Callable[[Event], tuple[int, int]],
    ) -> None:
        """``writer``: the command queue of this process. ``stamp``: see :class:`Echo`."""
        self.block = block
        self.stamp = stamp
        self.echo = Echo(block, stamp)
        self._writer = writer
        self._bells = bells
        self._loop = asyncio.get_running_loop()
        self._commander = Commander(block, writer)
        self._prepared = False
        self._preparing = asyncio.Lock()
        self._pending: dict[int, Pending] = {}
        self._followers = Followers()
        self._untaken_bytes = 0  # of records that may still lie in the queue
        self._open_events = 0
        self._silent = False
        self._turn = asyncio.Lock()  # who waits for room is served in order
        self._freed: asyncio.Future[None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._cursor = block.events.cursor()
        self._missed = 0  # events, as last told
        self._following = False
        self._again = False  # whether the loop is about to look without a bell

    @property
    def alive(self) -> bool:
        """Whether the block's events are being followed, as long as there are any."""
        return self._following or self.block.retired

    @property
    def over(self) -> bool:
        """Whether nothing is left of it: it follows no events, and has no value under way and no stream."""
        return not (self._following or self._pending or self._turn.locked() or self.echo.busy)

    def start(self) -> None:
        """Begin to follow the events."""
        self._following = True
        self._bells.join(self.block, self._look)

    def stop(self) -> None:
        """Follow them no more."""
        self._end_following()
        if self._timer is not None:
            self._timer.cancel()

    def ready(self, values: Mapping[str, object]) -> bool:
        """Whether :meth:`send`, or :meth:`give`, would not have to wait."""
        return self._prepared and not self._turn.locked() and self._has_room(self._cost(values))

    async def writable(self, registers: Iterable[Register]) -> bool:
        """Whether the configuration lets all of them be written."""
        await self._prepare()
        return all(map(self._commander.is_writable, registers))

    async def send(self, values: Mapping[str, object], done: Done, accepted: Callable[[], None] | None = None) -> None:
        """Send values of registers, by path, as one command as soon as there is room.

        ``done`` is called once, when the end of all is known, a bounded time later; ``accepted`` before, if the source
        accepts them. CommandError: one is not writable, or the source is silent; ValueRangeError: neither is called.
        """
        await self._send(partial(self._commander.submit, values), self._cost(values), done, accepted)

    async def give(
        self, injection: int, values: Mapping[str, object], done: Done, accepted: Callable[[], None] | None = None
    ) -> None:
        """The same for values as an injection's; ``accepted`` is called of one over ``/in`` only."""
        await self._send(partial(self._commander.give, injection, values), self._cost(values), done, accepted)

    def lay(self, registers: Collection[Register], follower: Follower, done: Done, **laid: Unpack[Laid]) -> int:
        """Have an injection laid over registers; its number. Never waits. CommandError: not sent."""
        bits = bytearray(self.block.layout.size)
        for register in registers:
            for at, own in enumerate(bits_of(register), register.offset):
                bits[at] |= own
        ticket = self._commander.lay(bytes(bits), **laid)
        cost = Cost.of([register.size for register in registers], laid.get("name", ""))
        self._follow_up(ticket, cost, done)
        self._followers.add(ticket.number, follower)
        return ticket.number

    def lift(self, injection: int, done: Done) -> None:
        """Have an injection lifted, whose follower is told nothing more. Never waits. CommandError: not sent."""
        self._followers.remove(injection)
        self._follow_up(self._commander.ask_to_lift(injection), Cost.of(()), done)

    async def _send(
        self, submit: Callable[[], Ticket], cost: Cost, done: Done, accepted: Callable[[], None] | None
    ) -> None:
        async with self._turn:
            await self._prepare()
            while not self._has_room(cost):
                self._freed = self._loop.create_future()
                await self._freed
            if self.block.retired:
                raise CommandError(_RETIRED)
            if self._silent and self._pending:  # one at a time asks whether it is back
                raise CommandError(
                    f"source {self.block.source} does not answer; shmio-supervisor status says how it fares"
                )
            self._follow_up(submit(), cost, done, accepted)

    def _follow_up(self, ticket: Ticket, cost: Cost, done: Done, accepted: Callable[[], None] | None = None) -> None:
        items = set(range(len(ticket.paths)))
        self._pending[ticket.number] = Pending(ticket.incarnation, ticket.until_ns, cost, items, done, accepted)
        self._untaken_bytes += cost.record_bytes
        self._open_events += cost.events
        if self._timer is None:
            self._set_timer()

    def catch_up(self) -> None:
        """Deliver what has been told so far, to those who listen to what is written too."""
        newest = self.block.events.head()
        while self._following and self._cursor.last < newest:
            self._look()

    async def _prepare(self) -> None:
        if not self._prepared:
            async with self._preparing:  # not on the loop: for a big layout it takes seconds
                await asyncio.to_thread(self._commander.prepare)
                self._prepared = True

    def _cost(self, values: Mapping[str, object]) -> Cost:
        """What a command with these costs; PathError."""
        return Cost.of([find(self.block.layout, path).size for path in values])

    def _has_room(self, cost: Cost) -> bool:
        fits = self._untaken_bytes + cost.record_bytes <= self.block.commands.capacity
        return self._silent or not self._pending or (fits and self._open_events + cost.events <= MAX_OPEN)

    # ---- what the source says --------------------------------------------------------------------------------

    def _heed(self, event: Event) -> None:
        for channel, message in self.echo.follow(event):
            for listener in channel.listeners:
                listener.deliver(message)
        for item in self._followers.gather(event):
            self._followers.tell(item)
        if event.kind == EventKind.STARTED:
            self._restarted(event)
        elif event.writer == self._writer and (pending := self._pending.get(event.command)):
            self._silent = False
            self._hear(event, pending)

    def _hear(self, event: Event, pending: Pending) -> None:
        if not pending.taken:
            self._untaken_bytes -= pending.cost.record_bytes
        if end := pending.hear(event):
            self._end(event.command, *end)

    def _miss(self, count: int) -> None:
        reason = f"{count} events of source {self.block.source} were missed"
        self.echo.skip()
        self._followers.skip()
        self.echo.fail(reason)
        self._followers.fail(reason)

    def _restarted(self, event: Event) -> None:
        """A successor rejects what its predecessor had not taken; of what it had taken nobody knows."""
        self._silent = False
        soon_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
        for number, pending in list(self._pending.items()):
            if pending.incarnation == event.incarnation:
                continue
            if pending.taken:
                reason = "the source was restarted meanwhile; it is not known whether the value was written"
                self._end(number, EventKind.UNKNOWN, reason)
            else:
                pending.until_ns = min(pending.until_ns, soon_ns)
        self._set_timer()

    def _retired(self) -> None:
        for number in list(self._pending):
            self._end(number, EventKind.UNKNOWN, _RETIRED)
        self._followers.end(_RETIRED)
        self._free()

    def _end(self, number: int, kind: EventKind, reason: str) -> None:
        pending = self._pending.pop(number)
        self._open_events -= pending.cost.events
        if not pending.taken:
            self._untaken_bytes -= pending.cost.record_bytes
        pending.done(kind, reason)

    def _free(self) -> None:
        if self._freed is not None and not self._freed.done():
            self._freed.set_result(None)

    # ---- and what it does not say ----------------------------------------------------------------------------

    def _set_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._pending:
            first_ns = min(pending.until_ns for pending in self._pending.values())
            self._timer = self._loop.call_later(max(0.0, (first_ns - time.monotonic_ns()) / 1e9), self._expire)

    def _expire(self) -> None:
        self._timer = None
        now_ns = time.monotonic_ns()
        for number, pending in list(self._pending.items()):
            if pending.until_ns <= now_ns:
                self._silent |= not pending.taken
                reason = "the source gave no answer in time; it is not known whether the value was written"
                self._end(number, EventKind.UNKNOWN, reason)
        self._free()
        self._set_timer()

    # ---- the events ------------------------------------------------------------------------------------------

    def _end_following(self) -> None:
        if self._following:
            self._following = False
            self._bells.leave(self.block, self._look)

    def _look(self) -> None:
        """Heed the events that have come, a few at a time."""
        if not self._following:
            return  # it has left while the bell rang
        try:
            self._follow()
        except Exception:
            log.exception("the events of %s cannot be followed", self.block.source)
            self._end_following()

    def _look_again(self) -> None:
        self._again = False
        self._look()

    def _follow(self) -> None:
        retired = self.block.retired  # before looking: what was told before the end is still heeded
        for count in range(BATCH):
            event = self._cursor.poll()
            if (missed := self._cursor.missed - self._missed) > 0:
                self._missed += missed
                self._miss(missed)
            if event is not None:
                self._heed(event)
                continue
            if count:
                self._free()
            if retired:
                self._end_following()
                self._retired()
            return
        self._free()
        if not self._again:
            self._again = True
            self._loop.call_soon(self._look_again)
