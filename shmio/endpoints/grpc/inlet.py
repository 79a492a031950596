"""The way into one block: sends values, follows the block's events in a thread, and tells what became of each."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from shmio.endpoints.grpc.echo import Echo, Message
from shmio.errors import CommandError
from shmio.layout.model import Register
from shmio.layout.topic import find
from shmio.segment import DONE, ENDS, Block, Event, EventKind
from shmio.segment.commander import PATIENCE_S, Commander
from shmio.segment.events import EVENT_DATA_SIZE

log = logging.getLogger("shmio.grpc")

MAX_OPEN: Final = 512
"""Events that may be outstanding: a quarter of the ring, so that none is overwritten before it is read."""
BATCH: Final = 32
"""Most events that are handed to the event loop at once, so that streams get their turn in between."""
WAIT_S: Final = 0.2

_RETIRED: Final = "the source was changed or removed by a reload"

Done = Callable[[EventKind, str], None]
"""Called once with what became of a value, one of ``ENDS``, and the reason if the device does not have it."""


@dataclass(slots=True)
class _Pending:
    """A command whose end has not come."""

    incarnation: int
    until_ns: int
    record_bytes: int
    events: int
    items: int  # whose end has not come
    done: Done
    accepted: Callable[[], None] | None
    taken: bool = False
    failure: tuple[EventKind, str] | None = None  # the first


class Inlet:
    """Sends values to a block's source, in order, and keeps no more under way than it can hear the end of.

    All but the thread belongs to the event loop.
    """

    def __init__(
        self,
        block: Block,
        writer: int,
        loop: asyncio.AbstractEventLoop,
        stamp: Callable[[Event], tuple[int, int]],
    ) -> None:
        """``writer``: the command queue of this process. ``stamp``: see :class:`Echo`."""
        self.block = block
        self.echo = Echo(block, stamp)
        self._writer = writer
        self._loop = loop
        self._commander = Commander(block, writer)
        self._prepared = False
        self._preparing = asyncio.Lock()
        self._pending: dict[int, _Pending] = {}
        self._untaken_bytes = 0  # of records that may still lie in the queue
        self._open_events = 0
        self._silent = False
        self._turn = asyncio.Lock()  # who waits for room is served in order
        self._freed: asyncio.Future[None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._cursor = block.events.cursor()
        self._told = self._cursor.last  # number of the last event whose messages are on their way to the event loop
        self._asked: tuple[int, asyncio.Future[None]] | None = None
        self._asking = threading.Lock()  # around these two
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"inlet-{block.source}", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the block's events are being followed, as long as there are any."""
        return self._thread.is_alive() or self.block.retired

    @property
    def over(self) -> bool:
        """Whether nothing is left of it: no thread, no value under way, no stream."""
        return not (self._thread.is_alive() or self._pending or self._turn.locked() or self.echo.busy)

    def start(self) -> None:
        """Begin to follow the events."""
        self._thread.start()

    def stop(self) -> None:
        """Tell the thread to end; it does within ``WAIT_S``."""
        self._stopping.set()
        if self._timer is not None:
            self._timer.cancel()

    def join(self) -> None:
        """Wait until the thread has ended."""
        self._thread.join()

    def ready(self, values: Mapping[str, object]) -> bool:
        """Whether :meth:`send` would not have to wait."""
        return self._prepared and not self._turn.locked() and self._has_room(*self._cost(values))

    async def writable(self, registers: Iterable[Register]) -> bool:
        """Whether the configuration lets all of them be written."""
        await self._prepare()
        return all(map(self._commander.is_writable, registers))

    async def send(self, values: Mapping[str, object], done: Done, accepted: Callable[[], None] | None = None) -> None:
        """Send values of registers, by path, as one command as soon as there is room.

        ``done`` is called once, when the end of all is known, a bounded time later; ``accepted`` before, if the source
        accepts them. CommandError: one is not writable, or the source is silent; ValueRangeError: neither is called.
        """
        async with self._turn:
            await self._prepare()
            record_bytes, events = self._cost(values)
            while not self._has_room(record_bytes, events):
                self._freed = self._loop.create_future()
                await self._freed
            if self.block.retired:
                raise CommandError(_RETIRED)
            if self._silent and self._pending:  # one at a time asks whether it is back
                raise CommandError(
                    f"source {self.block.source} does not answer; shmio-supervisor status says how it fares"
                )
            ticket = self._commander.submit(values)
            self._pending[ticket.number] = _Pending(
                ticket.incarnation, ticket.until_ns, record_bytes, events, len(values), done, accepted
            )
            self._untaken_bytes += record_bytes
            self._open_events += events
            if self._timer is None:
                self._set_timer()

    async def caught_up(self) -> None:
        """Wait until what has been told so far is delivered, to those who listen to what is written too."""
        told = self._loop.create_future()
        with self._asking:
            head = self.block.events.head()
            if self._told < head and self._thread.is_alive():
                self._asked = head, told
            else:
                self._loop.call_soon(_set, told)  # behind what is on its way
        await told

    async def _prepare(self) -> None:
        if not self._prepared:
            async with self._preparing:  # not on the loop: for a big layout it takes seconds
                await asyncio.to_thread(self._commander.prepare)
                self._prepared = True

    def _cost(self, values: Mapping[str, object]) -> tuple[int, int]:
        """At most so many bytes in the queue, and events until the end, have writes of these; PathError."""
        sizes = [find(self.block.layout, path).size for path in values]
        return 64 + sum(24 + size for size in sizes), sum(2 + size // EVENT_DATA_SIZE for size in sizes)

    def _has_room(self, record_bytes: int, events: int) -> bool:
        fits = self._untaken_bytes + record_bytes <= self.block.commands.capacity
        return self._silent or not self._pending or (fits and self._open_events + events <= MAX_OPEN)

    # ---- what the source says --------------------------------------------------------------------------------

    def _on_events(self, events: list[Event], messages: list[Message]) -> None:
        for channel, message in messages:
            for listener in channel.listeners:
                listener.deliver(message)
        for event in events:
            if event.kind == EventKind.STARTED:
                self._restarted(event)
            elif pending := self._pending.get(event.command):
                self._silent = False
                self._hear(event, pending)
        self._free()

    def _hear(self, event: Event, pending: _Pending) -> None:
        if not pending.taken:
            pending.taken = True
            self._untaken_bytes -= pending.record_bytes
            if event.kind == EventKind.ACCEPTED and pending.accepted is not None:
                pending.accepted()
        if event.kind not in ENDS:
            return
        pending.items -= event.items
        kind = EventKind(event.kind)
        if kind not in DONE and pending.failure is None:
            pending.failure = kind, f"{kind}: {event.text}"
        if pending.items <= 0:
            self._end(event.command, *(pending.failure or (kind, "")))

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
        self._free()

    def _end(self, number: int, kind: EventKind, reason: str) -> None:
        pending = self._pending.pop(number)
        self._open_events -= pending.events
        if not pending.taken:
            self._untaken_bytes -= pending.record_bytes
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

    # ---- the thread ------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._follow()
        except Exception:
            log.exception("the events of %s cannot be followed", self.block.source)

    def _follow(self) -> None:
        cursor = self._cursor
        missed = 0
        while not self._stopping.is_set():
            retired = self.block.retired
            event = cursor.next(WAIT_S)
            if event is None:
                self._tell(cursor.last)
                if retired:
                    self._loop.call_soon_threadsafe(self._retired)
                    return
                continue
            ours: list[Event] = []
            messages: list[Message] = []
            for left in reversed(range(BATCH)):
                if cursor.missed != missed:
                    self.echo.skip()
                    reason = f"{cursor.missed - missed} events of source {self.block.source} were missed"
                    self._loop.call_soon_threadsafe(self.echo.fail, reason)
                    missed = cursor.missed
                messages += self.echo.follow(event)
                if event.writer == self._writer or event.kind == EventKind.STARTED:
                    ours.append(event)
                if not left or (event := cursor.poll()) is None:
                    break
            if ours or messages:
                self._loop.call_soon_threadsafe(self._on_events, ours, messages)
            self._tell(cursor.last)

    def _tell(self, number: int) -> None:
        """All up to this event is on its way."""
        with self._asking:
            self._told = number
            if self._asked is not None and self._asked[0] <= number:
                self._loop.call_soon_threadsafe(_set, self._asked[1])
                self._asked = None


def _set(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
