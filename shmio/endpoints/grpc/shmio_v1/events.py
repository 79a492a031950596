"""The call Events: streams the events of sources. Each event is converted once for all clients."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from typing import Any, Final

import grpc

from shmio.endpoints.grpc.encoding import field, number
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.wakeups import BatchReader, Callback, WakeUps
from shmio.errors import EndpointError, PathError, ShmioError, ValueRangeError
from shmio.local.events import EventReader
from shmio.messages import event_to_wire
from shmio.model.event import Event
from shmio.segment import Block, Segment
from shmio.segment.events import EVENT_SLOTS
from shmio.wire import shmio_v1_pb2 as wire
from shmio.wording import unknown

MAX_CALLS: Final = 256
"""Maximum number of open Events calls."""
MAX_SOURCES: Final = 256
BATCH_EVENTS: Final = 32
"""Maximum number of events that are converted before the event loop serves the streams again."""
BATCH_S: Final = 0.005
"""Time in s after which a batch ends early, because a single event may be about thousands of registers."""
LOG_BYTES: Final = 8 << 20
"""Maximum total size of the events in a block's log, in bytes.

The log also has at most as many events as the event ring has slots.
"""
MESSAGE_BYTES: Final = 1 << 18
"""Size at which a message with the events of all sources is complete."""

_SOURCES, _EVENTS = (wire.EventsResponse.DESCRIPTOR.fields_by_name[name].number for name in ("sources", "events"))
_MISSED: Final = wire.Event.DESCRIPTOR.fields_by_name["missed"].number


class EventLog:
    """The latest events of one block as messages, for all calls that follow the block.

    When the log is full, it drops the oldest events. A call that has not read them yet misses them.
    Use it only in the event loop's thread.
    """

    def __init__(self, block: Block, wake_ups: WakeUps, after: int) -> None:
        """Start after the event with the number ``after``."""
        self.block = block
        self.began = after
        self.reader = EventReader(block, after=after)
        self.first = 0
        """Index of the oldest entry. This is also the number of entries that were dropped so far."""
        self.missed = 0
        """Number of events that were overwritten in the ring before the log could read them."""
        self.listeners: dict[Callback, None] = {}  # in the order in which they came
        self._entries: deque[tuple[int, int, bytes]] = deque()  # event's number, events missed until then, message
        self._size = 0
        self._batches = BatchReader(block, wake_ups, self._read)

    @property
    def end(self) -> int:
        """Index of the next entry to come."""
        return self.first + len(self._entries)

    @property
    def ended(self) -> bool:
        """True if no more entries will come."""
        return not self._batches.alive

    @property
    def failed(self) -> bool:
        """True if the log can no longer follow the block, although the block is still in use."""
        return self.ended and not self.reader.ended

    def start(self) -> None:
        """Start following the block."""
        self._batches.start()
        self._batches.read_batch()

    def stop(self) -> None:
        """Stop following the block."""
        self._batches.stop()

    def entry(self, place: int) -> tuple[int, int, bytes]:
        """Return the entry at an index.

        Returns:
            The number of the event, the number of events that were missed until then, and the
            message.

        """
        return self._entries[place - self.first]

    def _read(self) -> bool:
        """Read a few events; return whether more are waiting."""
        before, followed = self.end, False
        try:
            self._read_batch()
            followed = not self.reader.ended
        finally:
            if not followed:  # after the last event, or after an error, which the caller reports
                self.stop()
            if self.end != before or not followed:
                for wake in tuple(self.listeners):
                    wake()
        return self.reader.behind

    def _read_batch(self) -> None:
        until_s = time.monotonic() + BATCH_S
        for _ in range(BATCH_EVENTS):
            event = self.reader.next()
            if event is None:
                return
            self._add(event)
            if time.monotonic() > until_s:
                return

    def _add(self, event: Event) -> None:
        found = event_to_wire(event)
        found.ClearField("missed")  # each call has its own
        message = found.SerializeToString()
        self.missed += event.missed
        self._entries.append((event.number, self.missed, message))
        self._size += len(message)
        while len(self._entries) > EVENT_SLOTS or self._size > LOG_BYTES:
            self._size -= len(self._entries.popleft()[2])
            self.first += 1


class EventLogs:
    """The event logs of all blocks that calls follow."""

    def __init__(self, wake_ups: WakeUps) -> None:
        self._wake_ups = wake_ups
        self._logs: dict[int, EventLog] = {}  # by the block's section

    def join(self, block: Block, wake: Callback, *, after: int) -> EventLog:
        """Join the log of a block, and return the log. The first call that joins starts the log.

        Args:
            block: The block to follow.
            wake: Called when there are new events, and when the log ends.
            after: If this starts the log: number of the event after which the log begins.

        """
        log = self._logs.get(block.section)
        if log is None:
            log = EventLog(block, self._wake_ups, after)
            log.start()
            self._logs[block.section] = log
        log.listeners[wake] = None
        return log

    def leave(self, log: EventLog, wake: Callback) -> None:
        """Leave a log. The log ends when the last call has left it."""
        log.listeners.pop(wake, None)
        if not log.listeners:
            log.stop()
            self._logs.pop(log.block.section, None)


class _Place:
    """The position of one call in a block's log."""

    def __init__(self, log: EventLog, after: int, missed: int = 0) -> None:
        """Start after the event with the number ``after``.

        Args:
            log: The log.
            after: Number of the last event that the call does not want.
            missed: Number of events that the call has missed already.

        """
        self.log = log
        self.missed = missed + max(0, log.began - after)
        self._after = after
        whole = after <= log.began
        self._next = 0 if whole else log.end
        self._log_missed = 0 if whole else log.missed

    def next(self) -> bytes | None:
        """Return the next serialised ``Event``, or None if there is none yet."""
        log = self.log
        if (dropped := log.first - self._next) > 0:
            self.missed += dropped
            self._next = log.first
        while self._next < log.end:
            event_number, log_missed, message = log.entry(self._next)
            self._next += 1
            if event_number <= self._after:  # the event is older than the call
                self._log_missed = log_missed
                continue
            missed = self.missed + log_missed - self._log_missed
            self.missed, self._log_missed = 0, log_missed
            return message + number(_MISSED, missed) if missed else message
        return None


class EventsCall:
    """An Events call: follows its sources, and collects their events."""

    def __init__(self, feeds: Mapping[str, Feed], logs: EventLogs, instance: str, sources: Sequence[str]) -> None:
        """Start following the sources.

        Raises:
            PathError: There is no such source.
            ValueRangeError: There are too many sources.

        """
        if len(sources) > MAX_SOURCES:
            raise ValueRangeError(
                f"{len(sources)} sources are named, but at most {MAX_SOURCES} are allowed; name none to follow all"
            )
        for source in sources:
            if source not in feeds:
                raise PathError(unknown("source", source, feeds))
        self._feeds = feeds
        self._logs = logs
        self._instance = instance
        self._wake = asyncio.Event()
        self._places: dict[str, _Place] = {}
        self._moved: dict[str, EventLog | None] = {}
        """The next log of each source that a reload has changed; None if the reload has removed it."""
        self._failure: EndpointError | None = None
        try:
            for source in dict.fromkeys(sources) or feeds:
                block = feeds[source].block
                after = block.events.head()
                self._places[source] = _Place(logs.join(block, self._wake.set, after=after), after)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop following the sources."""
        for log in (*(place.log for place in self._places.values()), *self._moved.values()):
            if log is not None:
                self._logs.leave(log, self._wake.set)
        self._places.clear()
        self._moved.clear()

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Prepare to follow the new blocks of these sources, after a reload."""
        for source in self._places.keys() & sources:
            feed, before = self._feeds.get(source), self._moved.get(source)
            if feed is not None and self._places[source].log.block is feed.block:
                continue  # the call began with this block
            log = None if feed is None else self._logs.join(feed.block, self._wake.set, after=0)
            if before is not None and before is not log:  # a second reload, before the client has read to the first
                self._places[source].missed += before.end + before.missed
                self._logs.leave(before, self._wake.set)
            self._moved[source] = log
        self._wake.set()

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield serialised EventsResponses, without end.

        Raises:
            EndpointError: The events of a source can no longer be read.

        """
        yield b"".join(field(_SOURCES, source.encode()) for source in self._places)
        while True:
            self._wake.clear()  # before the checks, so that no wake-up is lost
            if batch := self._batch():
                yield batch
            if self._failure is not None:
                raise self._failure
            if not batch:
                await self._wake.wait()

    def _batch(self) -> bytes:
        """Return waiting events up to a limit, from all sources in turn."""
        parts: list[bytes] = []
        size, waiting = 0, deque(self._places)
        while waiting and size < MESSAGE_BYTES:
            source = waiting.popleft()
            event = self._next(source)
            if event is not None:
                parts.append(field(_EVENTS, event))
                size += len(event)
                if source in self._places:
                    waiting.append(source)
        if self._places:  # another source comes first next time
            source = next(iter(self._places))
            self._places[source] = self._places.pop(source)
        return b"".join(parts)

    def _next(self, source: str) -> bytes | None:
        """Return the next serialised ``Event`` of a source, or None if there is none yet.

        If a reload has removed the source, the last event says so.
        """
        place = self._places[source]
        while (event := place.next()) is None and place.log.ended:
            if source not in self._moved:
                if place.log.failed:
                    self._failure = EndpointError(
                        f"source {source}: its events can no longer be read; see the endpoint's log"
                    )
                return None  # or the reload is not complete yet
            log = self._moved.pop(source)
            self._logs.leave(place.log, self._wake.set)
            if log is None:
                del self._places[source]
                removed = event_to_wire(place.log.reader.removed(self._instance))
                removed.missed = place.missed
                return removed.SerializeToString()
            place = self._places[source] = _Place(log, 0, place.missed)
        return event


class EventCalls:
    """Serves the call Events."""

    def __init__(self, feeds: Mapping[str, Feed], wake_ups: WakeUps, segment: Segment) -> None:
        self._feeds = feeds
        self._logs = EventLogs(wake_ups)
        self._instance = segment.instance
        self._open: set[EventsCall] = set()

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handler of the call, by name. The handler yields serialised messages."""
        return {"Events": grpc.unary_stream_rpc_method_handler(self.events, wire.EventsRequest.FromString)}

    async def events(self, request: wire.EventsRequest, context: Context) -> AsyncIterator[bytes]:
        """Stream new events of the requested sources; of all sources if the request names none.

        Statuses:
            NOT_FOUND: There is no such source.
            INVALID_ARGUMENT: There are too many sources.
            RESOURCE_EXHAUSTED: There are too many calls.
        """
        call = None
        try:
            if len(self._open) >= MAX_CALLS:
                raise EndpointError(
                    f"{MAX_CALLS} calls of Events are open, which is the maximum; one call can follow many sources"
                )
            call = EventsCall(self._feeds, self._logs, self._instance, request.sources)
            self._open.add(call)
            async for message in call.messages():
                yield message
        except ShmioError as error:
            await refuse(context, error)
        finally:
            if call is not None:
                self._open.discard(call)
                call.close()

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """Switch the streams of these sources to their new blocks, after a reload."""
        for call in self._open:
            call.on_sources_replaced(sources)
