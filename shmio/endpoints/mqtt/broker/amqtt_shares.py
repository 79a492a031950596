"""What clients of our own broker in Python may take of its memory; what they are refused is counted, and told."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, Final, NamedTuple

MAX_CONNECTIONS: Final = 256
MESSAGE_BYTES: Final = 1000
"""Of one in memory, about, beside its payload."""
EXCHANGE_BYTES: Final = 5000
"""Of a message of QoS 2 that is not finished, about, beside its payload: a task waits with it."""
TASK_BYTES: Final = 1000
"""Of a packet that was dealt with, about, as long as an older one is not."""
UNHANDLED_BYTES: Final = 256 << 10
"""Of what one client has sent, and was not handed on: then no more is read of it."""

log = logging.getLogger("shmio.mqtt")


class Bound(NamedTuple):
    """Bytes that one client may take, and all of them together; nobody is refused his fair part of those."""

    one: int
    together: int

    def broken(self, own: int, everybody: Callable[[], Iterable[int]]) -> bool:
        """Whether one that takes ``own`` takes too much."""
        return own > self.one or (own > self.together // MAX_CONNECTIONS and sum(everybody()) > self.together)


class Refusals:
    """Counts what clients are refused; tells of the same again and again but once."""

    def __init__(self) -> None:
        self.count = 0
        self._last = ("", "")

    def tell(self, what: str, client: str) -> None:
        """``what``: with a place for the client's name, and what to do about it."""
        self.count += 1
        if (what, client) != self._last:
            self._last = what, client
            log.warning(what, client)


class Waiting(asyncio.Queue[Any]):
    """What one client has sent, or is to be sent. Its bound is kept by who fills it: a full one would drop some."""

    def _init(self, maxsize: int) -> None:
        super()._init(maxsize)
        self.bytes = 0
        self._room = asyncio.Event()
        self._room.set()

    def _put(self, item: Any) -> None:
        super()._put(item)
        self._count(_size(item))

    def _get(self) -> Any:
        item = super()._get()
        self._count(-_size(item))
        return item

    def _count(self, size: int) -> None:
        self.bytes += size
        (self._room.set if self.bytes < UNHANDLED_BYTES else self._room.clear)()

    async def room(self) -> None:
        """Wait until there is some."""
        await self._room.wait()


def _size(item: Any) -> int:
    """Of a message; or of topics that are subscribed to, or no longer, which are as short as their packet."""
    return MESSAGE_BYTES + len(item.data) if hasattr(item, "data") else MESSAGE_BYTES * len(item.topics)


class Exchanges(OrderedDict[int, Any]):
    """Messages of QoS 2, by their numbers, that their client has not released yet."""

    def __init__(self) -> None:
        super().__init__()
        self.packets = 0
        """Read since the connection was made; counted by who reads."""
        self._bytes = 0
        self._begun: dict[int, int] = {}
        """By number: what ``packets`` was when it began. None of before the connection: their tasks have an end."""

    def connected(self) -> None:
        """There is a new connection."""
        self.packets = 0
        self._begun.clear()

    @property
    def bytes(self) -> int:
        """What they take; the library also keeps each task that was begun after the oldest of them."""
        oldest = next(iter(self._begun.values()), self.packets)
        return self._bytes + TASK_BYTES * (self.packets - oldest)

    def __setitem__(self, number: int, message: Any) -> None:
        before = self.get(number)
        if before is not message:
            if before is not None:
                del self[number]
            self._bytes += EXCHANGE_BYTES + len(message.data)
            self._begun[number] = self.packets
        super().__setitem__(number, message)

    def __delitem__(self, number: int) -> None:
        self._bytes -= EXCHANGE_BYTES + len(self[number].data)
        self._begun.pop(number, None)
        super().__delitem__(number)


class Retained:
    """Whose the retained topics are; those of the bridge are not counted. A topic outlives its client."""

    def __init__(self, bound: Bound) -> None:
        self._bound = bound
        self._topics: dict[str, tuple[str, int]] = {}
        self._of: dict[str, int] = {}
        self._bytes = 0

    def forget(self, topic: str) -> None:
        """It is nobody's."""
        client, size = self._topics.pop(topic, ("", 0))
        if size:
            self._bytes -= size
            self._of[client] -= size
            if not self._of[client]:
                del self._of[client]

    def keep(self, topic: str, client: str, size: int) -> bool:
        """Make it this client's, which it was not; whether there was room."""
        size += MESSAGE_BYTES + len(topic)
        own = self._of.get(client, 0) + size
        if own > self._bound.one or self._bytes + size > self._bound.together:
            return False
        self._topics[topic] = client, size
        self._of[client] = own
        self._bytes += size
        return True
