"""Tracks which requests are in flight, and matches answers to them. No I/O.

Reads of the block, writes and the mode query share one connection and the jobs that the controller
granted. Every request has its own reference, and each answer is taken once by the operation that
asked, or not at all.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

from shmio.connectors.s7 import pdu
from shmio.errors import ConnectorError


class Operation(Protocol):
    """A group of requests with a common result."""

    @property
    def count(self) -> int:
        """Number of requests in all."""

    sent: int
    """Number of requests that ``take`` has returned."""

    @property
    def complete(self) -> bool:
        """Whether no more answers are expected."""

    def take(self, count: int, first: int) -> bytes | memoryview:
        """Return the next ``count`` requests as frames, with references from ``first`` on.

        References have 16 bits and wrap.
        """

    def accept(self, index: int, frame: memoryview) -> None:
        """Take the answer to request ``index``; ConnectorError if it does not match."""


class Window:
    """Keeps at most ``jobs`` requests in flight.

    References count from ``reference`` and wrap after 65535.
    """

    def __init__(self, jobs: int, reference: int) -> None:
        self.jobs = jobs
        self.reference = reference
        self._queue: deque[Operation] = deque()
        self._under_way: dict[int, tuple[Operation, int]] = {}
        self._given: list[tuple[Operation, int]] = []  # from the last ``due``: operations, each with its first request

    @property
    def idle(self) -> bool:
        """Whether no answer is outstanding."""
        return not self._under_way

    @property
    def waiting(self) -> bool:
        """Whether requests wait to be sent."""
        return bool(self._queue)

    def add(self, operation: Operation, *, urgent: bool = False) -> None:
        """Queue the requests of an operation, before all others if ``urgent``."""
        if urgent:
            self._queue.appendleft(operation)
        else:
            self._queue.append(operation)

    def due(self) -> bytes | memoryview:
        """Return the requests that may be sent now; empty if there are none."""
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
        """Mark the requests that ``due`` returned last as unsent.

        Call it when the connection was lost.
        """
        for operation, begin in self._given:
            operation.sent = begin

    def accept(self, frame: memoryview) -> None:
        """Pass an answer to the operation that asked; ConnectorError if none did."""
        reference = pdu.reference_of(frame)
        owner = self._under_way.pop(reference, None)
        if owner is None:
            pdu.check_answer(frame)  # a clearer reason, if it is not even an answer
            raise ConnectorError(f"answer to a request that is not under way (reference {reference})")
        owner[0].accept(owner[1], frame)
