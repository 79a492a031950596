"""Puts the messages of a source into order, and finds those that are missing. It does no I/O."""

from __future__ import annotations

from typing import Final, NamedTuple

from shmio.fabric.messages import Header

REQUEST_NS: Final = 300_000_000
"""Time in ns without a missing message after which the mirror requests those that are missing."""
REPEAT_NS: Final = 2_000_000_000
"""Time in ns after which the mirror repeats a request."""
PATIENCE_NS: Final = 6_000_000_000
"""Time in ns without a missing message after which the mirror gives up those that are missing."""
MAX_HELD_BYTES: Final = 32 << 20
"""Maximum size of the messages that wait for a missing one."""
FRESH_NS: Final = 10_000_000_000
"""Age in ns up to which a number of the registry bounds those of messages."""
MAX_AHEAD: Final = 1 << 20
"""Maximum difference between the number of a message and the newest number in the registry.

No source publishes that many messages between two entries of the registry.
"""
_OLD_STREAMS: Final = 16


class Received(NamedTuple):
    """A message.

    Attributes:
        header: Its header.
        data: All its bytes.
        at_ns: When it was received, on CLOCK_MONOTONIC, in ns.

    """

    header: Header
    data: bytes
    at_ns: int


class Lost(NamedTuple):
    """Messages that will not come: numbers ``first`` to ``last`` of a stream."""

    first: int
    last: int


class Missing(NamedTuple):
    """Messages to request: numbers ``first`` to ``last`` of a stream."""

    stream: int
    first: int
    last: int


class Announced(NamedTuple):
    """What the owner's entry in the registry says: its stream, the last number in it, and when this came, in ns.

    The number is None if the entry does not tell it.
    """

    stream: int
    number: int | None
    at_ns: int


class MessageOrder:
    """Orders the messages of one source. Each is delivered once.

    The first message that it gets is the first that it delivers. If an uplink was restarted, its new
    stream begins with message 1.

    The registry says which stream is the owner's, and which messages of it exist. So a message that
    another program has sent in the owner's name cannot keep the owner's own messages away.
    """

    def __init__(self) -> None:
        self._stream = 0
        self._old: dict[int, int] = {}  # the next number of each earlier stream
        self._announced: Announced | None = None
        self._doubt: tuple[int, int] | None = None  # since when, and the number that the registry does not reach
        self._next = 0
        self._held: dict[int, Received] = {}
        self._held_bytes = 0
        self._progress_ns = 0
        self._asked_ns: int | None = None

    @property
    def stream(self) -> int:
        """The owner's stream: that of the registry, or as long as it says nothing, that of the messages; 0: none."""
        return self._stream if self._announced is None else self._announced.stream

    @property
    def waiting(self) -> bool:
        """True while messages wait for a missing one."""
        return bool(self._held)

    def add(self, message: Received) -> list[Received | Lost]:
        """Add a message. Return what is now in order."""
        header = message.header
        found: list[Received | Lost] = []
        if header.stream != self._stream:
            if not self._is_owners(header.stream):
                return []
            found = self._give_up_all()
            begin = 1 if self._stream else header.number
            if self._stream:
                self._old[self._stream] = self._next
                if len(self._old) > _OLD_STREAMS:
                    del self._old[next(iter(self._old))]
            self._next = self._old.pop(header.stream, begin)
            self._stream, self._doubt = header.stream, None
            self._progress_ns, self._asked_ns = message.at_ns, None
        if header.number < self._next or header.number in self._held or self._is_absurd(message):
            return found
        if not self._held:
            self._progress_ns = message.at_ns
        if header.number < max(self._held, default=header.number):
            self._progress_ns = message.at_ns  # it fills a part of a hole
        self._held[header.number] = message
        self._held_bytes += len(message.data)
        found += self._ready(message.at_ns)
        while self._held_bytes > MAX_HELD_BYTES:
            found += self._give_up(message.at_ns)
        return found

    def announce(self, announced: Announced) -> None:
        """Take what the registry says about the owner's messages.

        An entry may be older than the last messages. But if the numbers in the entries have not reached
        that of the last message within ``PATIENCE_NS``, that number was false. Then the order continues
        after the number in the entry.
        """
        self._announced = announced
        if announced.number is None:
            return
        if announced.stream != self._stream or announced.number >= self._next - 1:
            self._doubt = None
        elif self._doubt is None or announced.number >= self._doubt[1] - 1:
            self._doubt = announced.at_ns, self._next
        elif announced.at_ns - self._doubt[0] >= PATIENCE_NS:
            self._held.clear()
            self._held_bytes = 0
            self._next, self._doubt = announced.number + 1, None

    def _is_owners(self, stream: int) -> bool:
        """Return whether to follow another stream: that of the registry, or as long as it says nothing, a new one."""
        if self._announced is not None:
            return stream == self._announced.stream
        return stream not in self._old

    def _is_absurd(self, message: Received) -> bool:
        known = self._announced
        if known is None or known.number is None:
            return False
        if known.stream != self._stream or message.at_ns - known.at_ns > FRESH_NS:
            return False
        return message.header.number > max(known.number, self._next) + MAX_AHEAD

    def missing(self, now_ns: int) -> Missing | None:
        """Return the first messages to request now; None if there are none, or it is too early."""
        if not self._held or now_ns - self._progress_ns < REQUEST_NS:
            return None
        if self._asked_ns is not None and now_ns - self._asked_ns < REPEAT_NS:
            return None
        self._asked_ns = now_ns
        return Missing(self._stream, self._next, min(self._held) - 1)

    def answered(self, missing: Missing, now_ns: int) -> list[Received | Lost]:
        """Give up the messages that the answer to a request did not have. Return what is now in order."""
        if missing.stream != self._stream or not self._held or self._next > missing.last:
            return []
        return self._give_up(now_ns)

    def expired(self, now_ns: int) -> list[Received | Lost]:
        """Give up messages for which there was neither an answer nor progress. Return what is now in order."""
        if not self._held or now_ns - self._progress_ns < PATIENCE_NS:
            return []
        return self._give_up(now_ns)

    def suspend(self, now_ns: int) -> None:
        """Do not count the time until now as time without progress, because there is no connection."""
        self._progress_ns, self._asked_ns = now_ns, None

    def patience_ns(self, now_ns: int) -> int | None:
        """Return the time in ns until :meth:`missing` or :meth:`expired` may have a result.

        None if no message waits.
        """
        if not self._held:
            return None
        ask_ns = self._progress_ns + REQUEST_NS if self._asked_ns is None else self._asked_ns + REPEAT_NS
        return max(1_000_000, min(ask_ns, self._progress_ns + PATIENCE_NS) - now_ns)

    def _ready(self, now_ns: int) -> list[Received | Lost]:
        found: list[Received | Lost] = []
        while (message := self._held.pop(self._next, None)) is not None:
            self._held_bytes -= len(message.data)
            self._next += 1
            found.append(message)
        if found:
            self._progress_ns, self._asked_ns = now_ns, None
        return found

    def _give_up(self, now_ns: int) -> list[Received | Lost]:
        """Count the messages before the first one that waits as lost."""
        first = min(self._held)
        lost = Lost(self._next, first - 1)
        self._next = first
        return [lost, *self._ready(now_ns)]

    def _give_up_all(self) -> list[Received | Lost]:
        found: list[Received | Lost] = []
        while self._held:
            found += self._give_up(self._progress_ns)
        return found
