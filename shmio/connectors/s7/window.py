"""Which requests are under way, and whose each answer is. No I/O.

Reads of the block, writes and the question for the operating mode share one connection and the jobs that the controller
granted. Every request has a reference of its own; an answer is taken by the one that asked, once, or not at all.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

from shmio.connectors.s7 import pdu
from shmio.errors import ConnectorError


class Operation(Protocol):
    """Some requests that belong together, and what their answers come to."""

    @property
    def count(self) -> int:
        """Requests in all."""

    sent: int
    """Requests given by ``take``."""

    @property
    def complete(self) -> bool:
        """Whether nothing more is expected."""

    def take(self, count: int, first: int) -> bytes | memoryview:
        """Give the next ``count`` requests as frames, with the references from ``first`` on (16 bits, wrapping)."""

    def accept(self, index: int, frame: memoryview) -> None:
        """Take the answer to the request of this index; ConnectorError if it is not exactly one."""


class Window:
    """Keeps at most ``jobs`` requests under way. References count on from ``reference``, wrapping after 65535."""

    def __init__(self, jobs: int, reference: int) -> None:
        self.jobs = jobs
        self.reference = reference
        self._queue: deque[Operation] = deque()
        self._under_way: dict[int, tuple[Operation, int]] = {}
        self._given: list[tuple[Operation, int]] = []  # by the last ``due``: whose, from which of its requests on

    @property
    def idle(self) -> bool:
        """Whether no answer is due."""
        return not self._under_way

    @property
    def waiting(self) -> bool:
        """Whether there are requests that are not sent yet."""
        return bool(self._queue)

    def add(self, operation: Operation, *, urgent: bool = False) -> None:
        """Have an operation's requests sent, after those of others; ``urgent``: before them."""
        if urgent:
            self._queue.appendleft(operation)
        else:
            self._queue.append(operation)

    def due(self) -> bytes | memoryview:
        """Give what may be sent now; empty if nothing may."""
        parts: list[bytes | memoryview] = []
        self._given.clear()
        while self._queue and (free := self.jobs - len(self._under_way)) > 0:
            operation = self._queue[0]
            begin = operation.sent
            self._given.append((operation, begin))
            parts.append(operation.take(min(free, operation.count - begin), self.reference))
            for index in range(begin, operation.sent):
                self._under_way[self.reference] = operation, index
                self.reference = (self.reference + 1) & 0xFFFF
            if operation.sent == operation.count:
                self._queue.popleft()
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def take_back(self) -> None:
        """Know that what ``due`` gave last has not gone out, not a byte of it; the connection is lost."""
        for operation, begin in self._given:
            operation.sent = begin

    def accept(self, frame: memoryview) -> None:
        """Hand an answer to the operation that asked; ConnectorError if none did."""
        reference = pdu.reference_of(frame)
        owner = self._under_way.pop(reference, None)
        if owner is None:
            pdu.check_answer(frame)  # a clearer reason, if it is not even an answer
            raise ConnectorError(f"answer to a request that is not under way (reference {reference})")
        owner[0].accept(owner[1], frame)
