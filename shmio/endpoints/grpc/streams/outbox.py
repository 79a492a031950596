"""What waits between sources and one client's stream, of one topic or of many."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Sized
from functools import partial
from typing import Any, Final

from shmio.endpoints.grpc.streams.back_pressure import LATE_S, Backlog, LossMonitor, TotalBacklog
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.subject import Subject
from shmio.segment.events import EVENT_SLOTS

TOPIC_BOUND: Final = 64
"""Values of one topic that may wait: more than a feed that catches up delivers."""
STATE_BOUND: Final = 4096
"""When so many values of all topics of a stream wait, it is given only the newest of each."""
EVENT_BOUND: Final = 2 * EVENT_SLOTS
"""Events that may wait in a stream; an inlet that catches up delivers half of it at once."""
STEP_BOUND: Final = 16_384
"""Values that may wait of which none may be left out: what one step changes in all topics of a stream."""
STEP_BOUND_BYTES: Final = 64 << 20
"""The same in bytes."""

Finish = Callable[[Any], bytes]


class Outbox:
    """Messages of its lanes in the order in which they came; for the event loop's thread alone, with one reader."""

    def __init__(self, total: TotalBacklog | None = None) -> None:
        total = total or TotalBacklog()
        self.states, self.events = Backlog(total), Backlog(total)
        self.dropped = 0
        self.failure = ""
        """Why it ended; empty: it did not fail."""
        self.on_failure: Callable[[], object] | None = None
        """Called then: the stream itself may wait for its client, who does not read, for ever."""
        self._waiting: OrderedDict[int, tuple[_Lane, Sized, float]] = OrderedDict()  # and of when it is
        self._next = 0
        self._waiter: asyncio.Future[None] | None = None
        self._ended = False
        self._owed = 0  # messages up to this number are waited for
        self._taken = 0  # those before this number have left, or were dropped
        self._told: asyncio.Future[None] | None = None
        self._asked = False  # whether the reader waits
        self.losses = LossMonitor()
        self.refills: dict[Callable[[], object], None] = {}
        """Called, once, as soon as nothing waits: who has more, and waits for that."""

    @property
    def busy(self) -> bool:
        """Whether its client takes what there was for it."""
        return bool(self._waiting) or not self._asked

    @property
    def behind(self) -> bool:
        """Whether that is far less than there could be."""
        return self.losses.behind

    def skip(self, frames: int, topics: int) -> None:
        """So many frames of so many topics were not delivered to it, which is too slow for them."""
        self.dropped += frames
        self.losses.skip(frames * topics)

    def add(self, lane: _Lane, message: Sized, at_s: float = 0.0) -> int:
        """Take a message; its number. ``at_s``: for :meth:`since`."""
        number = self._next
        self._next = number + 1
        self._waiting[number] = lane, message, at_s
        lane.load.add(message)
        if self._waiter is not None:
            self._wake()
        return number

    def since(self, number: int) -> float:
        """Of when one is that waits."""
        return self._waiting[number][2]

    def drop(self, number: int) -> None:
        """Drop one that waits."""
        lane, message, _ = self._waiting.pop(number)
        lane.load.remove(message)
        self.dropped += 1

    def clear(self) -> None:
        """Drop all that waits."""
        for lane, _, _ in list(self._waiting.values()):
            lane.drop()

    def close(self) -> None:
        """Its stream is over: what waits is nobody's, and was not dropped for being too much; nothing is owed."""
        for lane, message, _ in self._waiting.values():
            lane.load.remove(message)
        self._waiting.clear()
        self._owed = 0
        self._tell()

    def end(self) -> None:
        """Have the reader end once it has read what waits."""
        self._ended = True
        self._wake()

    def fail(self, reason: str) -> None:
        """End at once; what waits is dropped, and all that comes."""
        failed, self.failure = self.failure, self.failure or reason
        self.clear()
        self.end()
        self._tell()
        if self.on_failure and not failed:
            asyncio.get_running_loop().call_soon(self.on_failure)  # not while what it leaves is gone through

    def owe(self) -> None:
        """What has been added so far is waited for by :meth:`taken`."""
        self._owed = self._next

    @property
    def owing(self) -> bool:
        """Whether its client has not taken all that is waited for."""
        return self._taken < self._owed and not self.failure

    async def taken(self) -> None:
        """Wait until its client has taken all that is owed, or its stream is over."""
        while self.owing:
            self._told = asyncio.get_running_loop().create_future()
            try:
                await self._told
            finally:
                self._told = None

    def _tell(self) -> None:
        """Have :meth:`taken` look."""
        if self._told is not None and not self._told.done() and not self.owing:
            self._told.set_result(None)

    async def pop(self) -> bytes | None:
        """The oldest message, waited for; None at the end, from where it begins anew.

        The one given before is with the client then, as far as flow control lets it.
        """
        waiting = self._waiting
        self._taken = next(iter(waiting)) if waiting else self._next
        if self._told is not None:
            self._tell()
        self._asked = True
        while not waiting:
            if self._ended:
                self._ended = self._asked = False
                return None
            if self.refills:
                refills, self.refills = self.refills, {}
                for refill in refills:
                    refill()
                continue
            self._waiter = asyncio.get_running_loop().create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        self._asked = False
        _, (lane, message, _) = waiting.popitem(last=False)
        return lane.take(message)

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)


class _Lane:
    """One topic's part of an outbox."""

    def __init__(self, outbox: Outbox, load: Backlog, finish: Finish) -> None:
        self.load = load
        self._outbox = outbox
        self._finish = finish
        self._numbers: deque[int] = deque()

    def take(self, message: Sized) -> bytes:
        """Its oldest message, which has left the outbox, as it is sent."""
        self._numbers.popleft()
        self.load.remove(message)
        return self._finish(message)

    def drop(self) -> None:
        """Drop what waits of it."""
        while self._numbers:
            self._outbox.drop(self._numbers.popleft())

    def keep(self, message: Sized) -> None:
        """Add one of a step's messages, of which none is left out: without room for it the whole outbox fails.

        The step waits until the client has taken it.
        """
        if self.load.full(message, STEP_BOUND, STEP_BOUND_BYTES):
            self._outbox.fail(f"{self.load.count} values wait to be read: too many change in one step for this stream")
        self._add(message)
        self._outbox.owe()

    def _add(self, message: Sized, at_s: float = 0.0) -> None:
        if self._outbox.failure:
            self._outbox.dropped += 1
        else:
            self._numbers.append(self._outbox.add(self, message, at_s))


class StateLane(_Lane):
    """For states: every change for a client that keeps up; for one that does not the newest value, the loss is counted.

    A client that has fallen behind is not shown the past. It is a feed's listener.
    """

    def __init__(self, outbox: Outbox, finish: Finish = bytes) -> None:
        """``finish``: what a message still lacks when it is sent."""
        super().__init__(outbox, outbox.states, finish)
        self.stream = outbox
        self.since = 0

    def deliver(self, message: Sized, at_s: float | None = None) -> None:
        """Add a message, in place of the topic's that wait if they are too many, or too old beside it."""
        waits = len(self._numbers)  # of a client that keeps up nothing does, and this is all
        outbox, numbers, now_s = self._outbox, self._numbers, time.monotonic()
        at_s = now_s if at_s is None else at_s
        outbox.losses.offer(now_s)
        if waits >= TOPIC_BOUND or (self.load.count and self.load.full(message, STATE_BOUND)):
            self.drop()
        elif waits and outbox.losses.behind:
            while numbers and at_s > outbox.since(numbers[0]) + LATE_S:
                outbox.drop(numbers.popleft())
        outbox.losses.lose(waits - len(numbers))
        self._add(message, at_s)

    def lose(self) -> None:
        """What waits must not be sent any more."""
        self.drop()

    def join(self, feed: Feed, subject: Subject) -> Callable[[], None]:
        """Listen to what comes out of a feed's source; how to leave again."""
        feed.listen(subject, self)
        return partial(feed.leave, subject, self)


class EventLane(_Lane):
    """For events, of which none replaces another: every one of them, or the end, with what waits dropped and counted.

    It is an echo's listener.
    """

    def __init__(self, outbox: Outbox, path: str, finish: Finish = bytes) -> None:
        """``path``: named when the outbox fails. ``finish``: what a message still lacks when it is sent."""
        super().__init__(outbox, outbox.events, finish)
        self._path = path

    def deliver(self, message: Sized) -> None:
        """Add a message, or fail if there is no room."""
        if self.load.full(message, EVENT_BOUND):
            self.fail(f"{self.load.count} messages wait to be read: the client is too slow for what is written")
        self._add(message)

    def fail(self, reason: str) -> None:
        """End the whole outbox, what waits included: it is not all there was any more."""
        self._outbox.fail(f"{self._path}: {reason}")

    def join(self, feed: Feed, subject: Subject) -> Callable[[], None]:
        """Listen to what is written to a feed's source; how to leave again."""
        write_subscriptions = feed.commands.write_subscriptions
        write_subscriptions.listen(subject, self)
        return partial(write_subscriptions.leave, subject, self)


Lane = StateLane | EventLane
