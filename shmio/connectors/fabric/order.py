"""Puts the messages of a source into order, and finds those that are missing. It does no I/O."""

from __future__ import annotations

from collections import deque
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
_OLD_STREAMS: Final = 16


class Received(NamedTuple):
    """A message.

    Attributes:
        header: Its header.
        data: All its bytes.
        at_ns: When it was received, on CLOCK_MONOTONIC, in ns.
        late_ns: Its age in ns when it was received.

    """

    header: Header
    data: bytes
    at_ns: int
    late_ns: int = 0


class Lost(NamedTuple):
    """Messages that will not come: numbers ``first`` to ``last`` of a stream."""

    first: int
    last: int


class Missing(NamedTuple):
    """Messages to request: numbers ``first`` to ``last`` of a stream."""

    stream: int
    first: int
    last: int


class MessageOrder:
    """Orders the messages of one source. Each is delivered once.

    The first message that it gets is the first that it delivers. If an uplink was restarted, its new
    stream begins with message 1.
    """

    def __init__(self) -> None:
        self._stream = 0
        self._old: deque[int] = deque(maxlen=_OLD_STREAMS)
        self._next = 0
        self._held: dict[int, Received] = {}
        self._held_bytes = 0
        self._progress_ns = 0
        self._asked_ns: int | None = None
        self.newest: Received | None = None
        """The last message that was made; None before the first."""

    @property
    def waiting(self) -> bool:
        """True while messages wait for a missing one."""
        return bool(self._held)

    def add(self, message: Received) -> list[Received | Lost]:
        """Add a message. Return what is now in order."""
        header = message.header
        found: list[Received | Lost] = []
        if header.stream != self._stream:
            if header.stream in self._old:
                return []
            found = self._give_up_all()
            if self._stream:
                self._old.append(self._stream)
            self._next = 1 if self._stream else header.number
            self._stream = header.stream
            self.newest = None  # a restart of the owner may have set its clock back
            self._progress_ns, self._asked_ns = message.at_ns, None
        if header.number < self._next or header.number in self._held:
            return found
        if self.newest is None or header.made_ns >= self.newest.header.made_ns:
            self.newest = message
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
