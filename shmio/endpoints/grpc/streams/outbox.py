"""The queues of clients' streams. They may conflate states, but not events.

simlog.v1, simlog.v2 and simserver use :class:`Outbox`. shmio.v1 uses :class:`SendQueue`, and
conflates in :class:`shmio.endpoints.grpc.shmio_v1.subscribe.LatestFrame`.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sized
from contextlib import contextmanager
from functools import partial
from typing import Any, Final, Protocol

from shmio.endpoints.grpc.encoding import Subject
from shmio.endpoints.grpc.streams.back_pressure import LATE_S, Backlog, LossMonitor, TotalBacklog
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.segment.events import EVENT_SLOTS

TOPIC_BOUND: Final = 64
"""Maximum number of waiting values of one topic. A feed that catches up delivers fewer."""
STATE_BOUND: Final = 4096
"""Number of a stream's waiting values above which a new value replaces all waiting values of its topic."""
EVENT_BOUND: Final = 2 * EVENT_SLOTS
"""Maximum number of a stream's waiting events. It is twice as many as one catch-up can deliver."""
STEP_BOUND: Final = 16_384
"""Maximum number of a step's values that wait in a stream. No value of a step is dropped."""
STEP_BOUND_BYTES: Final = 64 << 20
"""Maximum size of a step's values that wait in a stream, in bytes."""

Finish = Callable[[Any], bytes]


class StepStream(Protocol):
    """A stream that has to take its part of a step."""

    on_taken: Callable[[StepStream], object] | None
    """Called once, when the client has taken the stream's part of a step, or when the stream has ended."""

    def give_up(self, reason: str) -> None:
        """End the stream, because its client takes too long."""


class Outbox:
    """The waiting messages of a stream, in the order in which they came. Each topic has a lane of its own.

    Only one reader may use :meth:`pop`. Use the outbox only in the event loop's thread.
    """

    def __init__(self, total: TotalBacklog | None = None) -> None:
        total = total or TotalBacklog()
        self.states, self.events = Backlog(total), Backlog(total)
        self.dropped = 0
        self.failure = ""
        """Why the outbox has failed; empty if it has not."""
        self.on_failure: Callable[[], object] | None = None
        """Called when the outbox fails, because a stream may wait for ever if its client does not read."""
        self._waiting: OrderedDict[int, tuple[_Lane, Sized, float]] = OrderedDict()  # messages with their time in s
        self._next = 0
        self._waiter: asyncio.Future[None] | None = None
        self._ended = False
        self._required = 0  # the client has to take the messages before this number
        self._taken = 0  # messages before this number were sent or dropped
        self.on_taken: Callable[[StepStream], object] | None = None
        self._asked = False  # whether the reader waits
        self.losses = LossMonitor()
        self.refills: dict[Callable[[], object], None] = {}
        """Functions to call once, as soon as no message is waiting."""

    @property
    def busy(self) -> bool:
        """True if messages are waiting, or if the client has not taken the last message yet."""
        return bool(self._waiting) or not self._asked

    @property
    def behind(self) -> bool:
        """True if the client loses so many values that it is far behind."""
        return self.losses.behind

    def skip(self, frames: int, topics: int) -> None:
        """Count frames that were not delivered to this slow client, on ``topics`` of its topics."""
        self.dropped += frames
        self.losses.skip(frames * topics)

    def add(self, lane: _Lane, message: Sized, at_s: float = 0.0) -> int:
        """Queue a message, and return its number.

        Args:
            lane: The lane of the message.
            message: The message.
            at_s: Time of the message, in s, which :meth:`since` returns.

        """
        number = self._next
        self._next = number + 1
        self._waiting[number] = lane, message, at_s
        lane.load.add(message)
        if self._waiter is not None:
            self._wake()
        return number

    def since(self, number: int) -> float:
        """Return the time of the waiting message with this number, in s."""
        return self._waiting[number][2]

    def drop(self, number: int) -> None:
        """Drop the waiting message with this number."""
        lane, message, _ = self._waiting.pop(number)
        lane.load.remove(message)
        self.dropped += 1

    def clear(self) -> None:
        """Drop all waiting messages."""
        for lane, _, _ in list(self._waiting.values()):
            lane.drop()

    def close(self) -> None:
        """Discard the waiting messages at the end of the stream. They do not count as dropped."""
        for lane, message, _ in self._waiting.values():
            lane.load.remove(message)
        self._waiting.clear()
        self._required = 0
        self._report_delivery()

    def end(self) -> None:
        """Make :meth:`pop` return None once it has returned the messages that are waiting now."""
        self._ended = True
        self._wake()

    def fail(self, reason: str) -> None:
        """End the stream at once. Drop all waiting messages, and all that are added later."""
        failed, self.failure = self.failure, self.failure or reason
        self.clear()
        self.end()
        self._report_delivery()
        if self.on_failure and not failed:
            asyncio.get_running_loop().call_soon(self.on_failure)  # later, as the caller may iterate over listeners

    def require_delivery(self) -> None:
        """Require that the client take all messages that have been added so far, before a step ends."""
        self._required = self._next

    @property
    def delivery_pending(self) -> bool:
        """True until the client has taken all messages that :meth:`require_delivery` marked."""
        return self._taken < self._required and not self.failure

    def give_up(self, reason: str) -> None:
        """End the stream, because its client takes too long."""
        self.fail(reason)

    def _report_delivery(self) -> None:
        """Call :attr:`on_taken` if the client has taken all messages that it has to take."""
        if self.on_taken is not None and not self.delivery_pending:
            taken, self.on_taken = self.on_taken, None
            taken(self)

    async def pop(self) -> bytes | None:
        """Wait for the oldest message, and return it. After :meth:`end`, return None.

        You may call this again after None. As far as flow control shows, each call means that the
        client has taken the previous message.
        """
        waiting = self._waiting
        self._taken = next(iter(waiting)) if waiting else self._next
        if self.on_taken is not None:
            self._report_delivery()
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
    """The messages of one topic in an outbox."""

    def __init__(self, outbox: Outbox, load: Backlog, finish: Finish) -> None:
        self.load = load
        self._outbox = outbox
        self._finish = finish
        self._numbers: deque[int] = deque()

    def take(self, message: Sized) -> bytes:
        """Complete the lane's oldest message, which has left the outbox, and return it."""
        self._numbers.popleft()
        self.load.remove(message)
        return self._finish(message)

    def drop(self) -> None:
        """Drop the lane's waiting messages."""
        while self._numbers:
            self._outbox.drop(self._numbers.popleft())

    def keep(self, message: Sized) -> None:
        """Add a message of a step. If there is no room for it, the whole outbox fails.

        The step waits until the client has taken the message.
        """
        if self.load.full(message, STEP_BOUND, STEP_BOUND_BYTES):
            self._outbox.fail(
                f"{self.load.count} values are waiting: too many values change in one step for this stream"
            )
        self._add(message)
        self._outbox.require_delivery()

    def _add(self, message: Sized, at_s: float = 0.0) -> None:
        if self._outbox.failure:
            self._outbox.dropped += 1
        else:
            self._numbers.append(self._outbox.add(self, message, at_s))


class StateLane(_Lane):
    """A lane for states. A slow client gets only the newest value; any other client gets every change.

    The outbox counts the values that are left out. The lane is a listener of a feed.
    """

    def __init__(self, outbox: Outbox, finish: Finish = bytes) -> None:
        """Create the lane.

        Args:
            outbox: The outbox of the stream.
            finish: Completes a message when it is sent.

        """
        super().__init__(outbox, outbox.states, finish)
        self.stream = outbox
        self.since = 0

    def deliver(self, message: Sized, at_s: float | None = None) -> None:
        """Add a message. Drop the lane's waiting messages if they are too many or too old."""
        waits = len(self._numbers)  # 0 if the client keeps up
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
        """Drop the lane's waiting messages, because the quality has become bad."""
        self.drop()

    def join(self, feed: Feed, subject: Subject) -> Callable[[], None]:
        """Listen to the values of a feed. Return the function that ends the subscription."""
        feed.listen(subject, self)
        return partial(feed.leave, subject, self)


class EventLane(_Lane):
    """A lane for events. No event replaces another. If there is no room for an event, the outbox fails.

    The lane is a listener of write subscriptions.
    """

    def __init__(self, outbox: Outbox, path: str, finish: Finish = bytes) -> None:
        """Create the lane.

        Args:
            outbox: The outbox of the stream.
            path: Path of the topic, for the text of a failure.
            finish: Completes a message when it is sent.

        """
        super().__init__(outbox, outbox.events, finish)
        self._path = path

    def deliver(self, message: Sized) -> None:
        """Add a message. If there is no room for it, the outbox fails."""
        if self.load.full(message, EVENT_BOUND):
            self.fail(f"{self.load.count} messages are waiting: the client reads too slowly")
        self._add(message)

    def fail(self, reason: str) -> None:
        """Make the whole outbox fail, because events are missing."""
        self._outbox.fail(f"{self._path}: {reason}")

    def join(self, feed: Feed, subject: Subject) -> Callable[[], None]:
        """Listen to the writes to a source. Return the function that ends the subscription."""
        write_subscriptions = feed.commands.write_subscriptions
        write_subscriptions.listen(subject, self)
        return partial(write_subscriptions.leave, subject, self)


Lane = StateLane | EventLane


class OpenStreams:
    """Counts the open streams of all services together. Use it only in the event loop's thread."""

    def __init__(self) -> None:
        self.changed: Callable[[], object] = lambda: None
        """Called when the first stream opens, before it gets values, and when the last stream closes."""
        self._count = 0

    def __bool__(self) -> bool:
        return self._count > 0

    @contextmanager
    def joined(self) -> Iterator[None]:
        """Count a stream within a ``with`` block."""
        self._count += 1
        if self._count == 1:
            self.changed()
        try:
            yield
        finally:
            self._count -= 1
            if not self._count:
                self.changed()


class Outboxes:
    """The outboxes of all open streams."""

    def __init__(self, open_streams: OpenStreams | None = None) -> None:
        """Start without outboxes.

        Args:
            open_streams: Counts the open streams of all services together.

        """
        self._open_streams = OpenStreams() if open_streams is None else open_streams
        self._open: set[Outbox] = set()
        self._dropped = 0
        self._total = TotalBacklog()

    @property
    def waiting_bytes(self) -> int:
        """Size of all waiting messages, in bytes."""
        return self._total.size

    def __len__(self) -> int:
        return len(self._open)

    @property
    def dropped(self) -> int:
        """Number of messages that were dropped since the start because a client was too slow."""
        return self._dropped + sum(outbox.dropped for outbox in self._open)

    @contextmanager
    def opened(self) -> Iterator[Outbox]:
        """Provide an outbox for a stream within a ``with`` block."""
        outbox = Outbox(self._total)
        self._open.add(outbox)
        self._total.streams += 1
        try:
            with self._open_streams.joined():
                yield outbox
        finally:
            self._open.discard(outbox)
            self._total.streams -= 1
            self._dropped += outbox.dropped
            outbox.close()

    def undelivered(self) -> list[Outbox]:
        """Return the outboxes whose clients have not yet taken all messages of a step."""
        return [outbox for outbox in self._open if outbox.delivery_pending]


MAX_WAITING: Final = 4096


class SendQueue:
    """A queue that limits the number and the size of its messages."""

    def __init__(self) -> None:
        self._messages: deque[bytes] = deque()
        self._load = Backlog(TotalBacklog())

    def __bool__(self) -> bool:
        return bool(self._messages)

    def add(self, message: bytes) -> str:
        """Add a message. Return an empty text or, if there is no room for the message, the reason."""
        if self._load.full(message, MAX_WAITING):
            return f"{self._load.count} messages are waiting: the client reads too slowly"
        self._load.add(message)
        self._messages.append(message)
        return ""

    def pop(self) -> bytes:
        """Remove and return the oldest message."""
        message = self._messages.popleft()
        self._load.remove(message)
        return message

    def all(self) -> bytes:
        """Remove all messages, and return them concatenated."""
        return b"".join([self.pop() for _ in range(len(self._messages))])
