"""Queues topics for the broker, in the order of their first change. A topic is sent with its newest value.

While there is no broker, every change goes to a bounded backlog instead. When there is a broker
again, the backlog is sent first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from shmio.endpoints.mqtt.topics import Channel, Message

OVERHEAD_BYTES: Final = 200
"""Approximate memory that a message needs in addition to its payload, in bytes."""
TURN_MESSAGES: Final = 500
"""Maximum number of messages that are sent in one go, before the bridge does other work."""
MAX_RESULTS: Final = 1024
"""Maximum number of queued results. If there are more, the oldest are dropped."""

Item = TypeVar("Item")


class _Entry(NamedTuple, Generic[Item]):
    number: int
    item: Item
    size: int
    changes: int


class Backlog(Generic[Item]):
    """A store of limited size, with several rows of items. Each row is first in, first out.

    If there is no room for an item, the oldest items of all rows are dropped.
    """

    def __init__(self, most_bytes: int) -> None:
        self.count = 0
        """Number of changes in the backlog."""
        self.dropped = 0
        """Number of changes that were dropped because there was no room."""
        self.bytes = 0
        self._most = most_bytes
        self._rows: dict[str, deque[_Entry[Item]]] = {}
        self._number = 0
        """Sequence number of the newest item. Older items have lower numbers."""

    def put(self, item: Item, size: int, *, row: str = "", changes: int = 1) -> None:
        """Append an item. If necessary, drop the oldest items to make room for it.

        Args:
            item: The item.
            size: Size of the item, in bytes.
            row: Name of the row.
            changes: Number of changes in the item.

        """
        self._number += 1
        self._rows.setdefault(row, deque()).append(_Entry(self._number, item, size, changes))
        self._add(changes, size)
        while self.bytes > self._most:
            oldest = min((kept for kept in self._rows.values() if kept), key=lambda kept: kept[0].number).popleft()
            self._add(-oldest.changes, -oldest.size)
            self.dropped += oldest.changes

    def put_back(self, item: Item, size: int) -> None:
        """Insert an item of ``size`` bytes before all others of the row ``""``; drop it if there is no room."""
        if self.bytes + size > self._most:
            self.dropped += 1
            return
        row = self._rows.setdefault("", deque())
        row.appendleft(_Entry(row[0].number - 1 if row else self._number, item, size, 1))
        self._add(1, size)

    def pop(self, row: str = "") -> Item | None:
        """Remove and return the oldest item of a row; return None if the row is empty."""
        kept = self._rows.get(row)
        if not kept:
            return None
        oldest = kept.popleft()
        self._add(-oldest.changes, -oldest.size)
        return oldest.item

    def clear(self) -> None:
        """Drop all items. They count as dropped."""
        self.dropped += self.count
        self.count = self.bytes = 0
        self._rows.clear()

    def _add(self, changes: int, size: int) -> None:
        self.count += changes
        self.bytes += size


class Sender(Protocol):
    """What the outbox needs of a connection."""

    @property
    def up(self) -> bool:
        """True if the connection is up."""

    @property
    def room(self) -> int:
        """Number of messages that can be sent now without being queued in memory."""

    def send(self, message: Message, properties: Properties | None = None) -> None:
        """Queue a message for :meth:`push`."""

    def push(self) -> None:
        """Write queued messages to the socket."""


class Outbox:
    """Queues topics and results for the broker. Use it only in the bridge's thread."""

    def __init__(self, connection: Sender, results: Sender, backlog_bytes: int) -> None:
        """Create the outbox.

        Args:
            connection: The connection for values.
            results: The connection for the results of commands.
            backlog_bytes: Maximum size of the backlog, in bytes.

        """
        self._connection, self._results = connection, results
        self._most = backlog_bytes
        self._backlog: Backlog[Message] = Backlog(backlog_bytes)
        self._waiting: dict[Channel, None] = {}
        self._results_waiting: deque[tuple[Message, Properties | None]] = deque(maxlen=MAX_RESULTS)
        self.keeping = False
        """True if changes are kept while there is no connection.

        It is set after the first connection, or after an attempt to connect has failed.
        """
        self._catching_up = False
        """True while the backlog, and after it the current state of every topic, is being sent."""
        self._catch_up_bytes = 0
        """Size in bytes up to which the backlog takes new changes while it is being sent.

        It shrinks as the backlog is sent. Otherwise the backlog would never end if changes come
        faster than the broker takes them.
        """
        self.sent = 0
        self._dropped_results = 0

    @property
    def busy(self) -> bool:
        """True if anything is queued."""
        return bool(self._waiting or self._backlog.count or self._results_waiting)

    @property
    def can_send(self) -> bool:
        """True if :meth:`flush` would send something now."""
        values, answers = self._waiting or self._backlog.count, self._results_waiting
        return bool((values and self._connection.room) or (answers and self._results.room))

    @property
    def waiting(self) -> int:
        """Number of topics that are waiting to be sent."""
        return len(self._waiting)

    @property
    def backlog(self) -> int:
        """Number of changes in the backlog."""
        return self._backlog.count

    @property
    def dropped(self) -> int:
        """Number of changes and results that were dropped."""
        return self._backlog.dropped + self._dropped_results

    def mark(self, channel: Channel) -> None:
        """Mark a topic as changed, so that it is sent.

        While the backlog is being sent, or during an outage (:attr:`keeping`), the change goes to
        the backlog, if it has room. Otherwise the topic waits; a topic that already waits keeps its
        place.
        """
        if self._connection.up and not (self._catching_up and self._backlog.bytes < self._catch_up_bytes):
            self._waiting[channel] = None
        elif self._catching_up or self.keeping:
            message = channel.message(late=True)
            if message.keep:
                self._backlog.put(message, _size(message))
            if self._connection.up:  # backlog messages are not retained, so the retained value must follow
                self._waiting[channel] = None

    def mark_all(self, channels: Iterable[Channel]) -> None:
        """Mark several topics as changed."""
        if self._connection.up and not self._catching_up:
            self._waiting |= dict.fromkeys(channels)
            return
        for channel in channels:
            self.mark(channel)

    def resend(self, channels: Iterable[Channel]) -> None:
        """Queue the present state of these topics. It is sent after the backlog."""
        if self._connection.up:
            self._waiting |= dict.fromkeys(channels)
            if not self._catching_up and self._backlog.count:
                self._catching_up, self._catch_up_bytes = True, self._most

    def queue_result(self, message: Message, properties: Properties | None) -> None:
        """Queue the result of a command, with its MQTT 5 properties. Results are sent before values."""
        if self._results.up:
            self._dropped_results += len(self._results_waiting) == MAX_RESULTS
            self._results_waiting.append((message, properties))

    def lose(self, unacknowledged: Iterable[Message]) -> None:
        """Handle a lost connection: move waiting changes and these unacknowledged messages to the backlog."""
        for message in reversed(list(unacknowledged)):
            if message.keep:
                self._backlog.put_back(message._replace(retain=False), _size(message))
        for channel in self._waiting:
            message = channel.message(late=True)
            if message.keep:
                self._backlog.put(message, _size(message))
        self._waiting.clear()
        self._catching_up = False

    def forget(self, channels: Iterable[Channel]) -> None:
        """Remove channels from the queue, without sending them."""
        for channel in channels:
            self._waiting.pop(channel, None)

    def flush(self) -> None:
        """Send queued messages in batches, as long as the connections have room, up to ``TURN_MESSAGES``."""
        if not self._results.up:
            self._results_waiting.clear()  # results are lost with their connection
        self._pass(self._results, self._answered)
        self._pass(self._connection, self._due)

    def _pass(self, connection: Sender, due: Callable[[], Iterator[tuple[Message, Properties | None]]]) -> None:
        rest, messages = TURN_MESSAGES, due()
        while (room := min(connection.room, rest)) > 0:
            rest -= room
            before = self.sent
            for message, properties in islice(messages, room):
                self.sent += 1
                connection.send(message, properties)
            if self.sent == before:
                return
            connection.push()

    def _answered(self) -> Iterator[tuple[Message, Properties | None]]:
        """Yield the queued results."""
        while self._results_waiting:
            yield self._results_waiting.popleft()

    def _due(self) -> Iterator[tuple[Message, Properties | None]]:
        """Yield the messages of the backlog, then those of the changed topics."""
        while (message := self._backlog.pop()) is not None:
            self._catch_up_bytes -= _size(message) // 2
            yield message, _time_of(message)
        for channel in list(islice(self._waiting, TURN_MESSAGES)):
            del self._waiting[channel]
            self._catching_up = self._catching_up and bool(self._waiting)
            yield channel.message(), None


def _time_of(message: Message) -> Properties | None:
    """Return the MQTT 5 property with the source time of a late value.

    Most payloads do not have this time.
    """
    if not message.source_ns:
        return None
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    properties.UserProperty = ("source_time", repr(message.source_ns / 1e9))
    return properties


def _size(message: Message) -> int:
    return OVERHEAD_BYTES + len(message.payload)
