"""What the broker is still to be told: topics in the order of their first change, each with its newest value.

While the broker is away each change is kept instead, in a bounded store, and sent before anything else when it is back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Final, Protocol

from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from shmio.endpoints.mqtt.backlog import Backlog
from shmio.endpoints.mqtt.channel import Channel, Message

OVERHEAD_BYTES: Final = 200
"""Of one message in memory, about, beside its payload."""
TURN_MESSAGES: Final = 500
"""So many are sent before what else there is to do has its turn."""
MAX_RESULTS: Final = 1024
"""Results of commands that wait; beyond that the oldest are dropped."""


class Sender(Protocol):
    """The connection to the broker."""

    @property
    def up(self) -> bool:
        """Whether there is one."""

    @property
    def room(self) -> int:
        """How many messages it takes now, and does not only put into its memory."""

    def send(self, message: Message, properties: Properties | None = None) -> None:
        """Have one ready to go."""

    def push(self) -> None:
        """Have go what is ready."""


class Outbox:
    """For the bridge's thread."""

    def __init__(self, connection: Sender, results: Sender, backlog_bytes: int) -> None:
        """``connection``: for values; ``results``: for what became of commands."""
        self._connection, self._results = connection, results
        self._most = backlog_bytes
        self._backlog: Backlog[Message] = Backlog(backlog_bytes)
        self._waiting: dict[Channel, None] = {}
        self._results_waiting: deque[tuple[Message, Properties | None]] = deque(maxlen=MAX_RESULTS)
        self.keeping = False
        """Whether changes are kept while there is no connection: it has failed, or there has been one."""
        self._catching_up = False
        """Whether the broker is being told all that was kept, and then how everything is."""
        self._catch_up_bytes = 0
        """Bytes up to which changes are kept meanwhile: fewer the more was sent, for else a broker that takes less
        than there is would be told of the past for ever."""
        self.sent = 0
        self._dropped_results = 0

    @property
    def busy(self) -> bool:
        """Whether anything is to be sent."""
        return bool(self._waiting or self._backlog.count or self._results_waiting)

    @property
    def can_send(self) -> bool:
        """Whether :meth:`flush` would send something now."""
        values, answers = self._waiting or self._backlog.count, self._results_waiting
        return bool((values and self._connection.room) or (answers and self._results.room))

    @property
    def waiting(self) -> int:
        """Topics whose turn has not come."""
        return len(self._waiting)

    @property
    def backlog(self) -> int:
        """Changes that are kept."""
        return self._backlog.count

    @property
    def dropped(self) -> int:
        """Changes that had no room, and answers."""
        return self._backlog.dropped + self._dropped_results

    def mark(self, channel: Channel) -> None:
        """Something about it is new. One that waits already keeps its place, and will be sent with what is new.

        Until all that was kept has been sent, what is new is kept behind it, if there is room.
        """
        if self._connection.up and not (self._catching_up and self._backlog.bytes < self._catch_up_bytes):
            self._waiting[channel] = None
        elif self._catching_up or self.keeping:
            message = channel.message(late=True)
            if message.keep:
                self._backlog.put(message, _size(message))
            if self._connection.up:  # what is kept is not retained; it may have been shown already
                self._waiting[channel] = None

    def mark_all(self, channels: Iterable[Channel]) -> None:
        """Something about all of them is new."""
        if self._connection.up and not self._catching_up:
            self._waiting |= dict.fromkeys(channels)
            return
        for channel in channels:
            self.mark(channel)

    def resend(self, channels: Iterable[Channel]) -> None:
        """Have all of them sent as they are when their turn comes, after what was kept."""
        if self._connection.up:
            self._waiting |= dict.fromkeys(channels)
            if not self._catching_up:
                self._catching_up, self._catch_up_bytes = True, self._most

    def queue_result(self, message: Message, properties: Properties | None) -> None:
        """Send what became of a command, before values."""
        if self._results.up:
            self._dropped_results += len(self._results_waiting) == MAX_RESULTS
            self._results_waiting.append((message, properties))

    def lose(self, unacknowledged: Iterable[Message]) -> None:
        """The connection is gone: keep what it has not taken for certain, and what waited for it."""
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
        """A reload has ended what they tell of."""
        for channel in channels:
            self._waiting.pop(channel, None)

    def flush(self) -> None:
        """Send as long as the connections take it, so many at once, and so many in all by each."""
        if not self._results.up:
            self._results_waiting.clear()  # they go with their connection
        self._pass(self._results, self._answered)
        self._pass(self._connection, self._due)

    def _pass(self, connection: Sender, due: Callable[[], Iterator[tuple[Message, Properties | None]]]) -> None:
        rest = TURN_MESSAGES
        while (room := min(connection.room, rest)) > 0:
            rest -= room
            before = self.sent
            for message, properties in islice(due(), room):
                self.sent += 1
                connection.send(message, properties)
            if self.sent == before:
                return
            connection.push()

    def _answered(self) -> Iterator[tuple[Message, Properties | None]]:
        """What became of commands."""
        while self._results_waiting:
            yield self._results_waiting.popleft()

    def _due(self) -> Iterator[tuple[Message, Properties | None]]:
        """Values, each as its turn comes: what was kept, then what is new."""
        while (message := self._backlog.pop()) is not None:
            self._catch_up_bytes -= _size(message) // 2
            yield message, _time_of(message)
        for channel in list(islice(self._waiting, TURN_MESSAGES)):
            del self._waiting[channel]
            self._catching_up = self._catching_up and bool(self._waiting)
            yield channel.message(), None


def _time_of(message: Message) -> Properties | None:
    """For MQTT 5: when a value that comes late was there; most payloads have no place for it."""
    if not message.source_ns:
        return None
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    properties.UserProperty = ("source_time", repr(message.source_ns / 1e9))
    return properties


def _size(message: Message) -> int:
    return OVERHEAD_BYTES + len(message.payload)
