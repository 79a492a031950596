"""The TCP connection to a controller, and the window of requests in flight on it.

Every wait is bounded by a deadline. Reads of the block, writes and the mode query share the
connection and the jobs that the controller granted. Every request has its own reference, and each
answer is taken once by the operation that asked, or not at all.
"""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from contextlib import suppress
from typing import Protocol

from shmio.connectors.s7 import pdu
from shmio.errors import ConnectorError


class Transport:
    """One TCP connection.

    Deadlines are ns of CLOCK_MONOTONIC; ``select`` keeps them to about 0.1 ms.
    """

    def __init__(self, host: str, port: int, timeout_ns: int) -> None:
        """Connect within ``timeout_ns``, plus the host name lookup; OSError if nothing answers."""
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        self.deadline_ns = time.monotonic_ns() + timeout_ns
        """When ``timeout_ns`` is over."""
        for attempt, (family, kind, protocol, _, address) in enumerate(places, 1):
            self._socket = socket.socket(family, kind, protocol)
            try:
                self._socket.settimeout(max(0.001, (self.deadline_ns - time.monotonic_ns()) / 1e9))
                self._socket.connect(address)
            except BaseException as error:
                self._socket.close()
                if attempt == len(places) or not isinstance(error, OSError):
                    raise
            else:
                break
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self.taken = 0
        """Bytes of the last ``send`` that the kernel has taken, also when it failed."""
        self.reserve(1, 512)  # more than any connection confirm

    def reserve(self, frames: int, longest: int) -> None:
        """Reserve room for ``frames`` frames of at most ``longest`` bytes.

        All received frames must be taken.
        """
        self._longest = longest
        self._inbox = memoryview(bytearray(frames * longest))
        self._start = self._end = 0  # of the bytes received, but not yet taken

    @property
    def left(self) -> int:
        """Number of bytes received but not yet taken."""
        return self._end - self._start

    def send(self, data: bytes | memoryview, deadline_ns: int) -> None:
        """Send all of ``data``; TimeoutError if the peer does not take it in time.

        The kernel buffers the answers that come meanwhile; with so few requests in flight they fit.
        """
        self.taken = 0
        with suppress(BlockingIOError):
            self.taken = self._socket.send(data)
        while self.taken < len(data):
            _, ready, _ = select.select((), (self._socket,), (), _left_s(deadline_ns))
            if not ready:
                raise TimeoutError
            self.taken += self._socket.send(data[self.taken :])

    def receive(self, until_ns: int) -> bool:
        """Receive what the socket has, waiting until ``until_ns``; return False if nothing came.

        Take all whole frames before the next call, so that there is always room.

        Raises:
            EOFError: The peer closed the connection.

        """
        ready, _, _ = select.select((self._socket,), (), (), _left_s(until_ns))
        if not ready:
            return False
        if self._start:
            left = self._end - self._start
            self._inbox[:left] = self._inbox[self._start : self._end]
            self._start, self._end = 0, left
        received = self._socket.recv_into(self._inbox[self._end :])
        if not received:
            raise EOFError
        self._end += received
        return True

    def frame(self) -> memoryview | None:
        """Take the next whole frame; None if there is none.

        It is valid until the next ``receive``.
        """
        if self._end - self._start < 4:
            return None
        length = pdu.frame_length(self._inbox, self._start, self._longest)
        if self._end - self._start < length:
            return None
        frame = self._inbox[self._start : self._start + length]
        self._start += length
        return frame

    def next_frame(self, deadline_ns: int) -> memoryview:
        """Wait for a whole frame; TimeoutError if it does not come in time."""
        while (frame := self.frame()) is None:
            if not self.receive(deadline_ns):
                raise TimeoutError
        return frame

    def close(self) -> None:
        """Close the socket. In class 0 of the transport protocol this ends the session."""
        self._socket.close()


def _left_s(until_ns: int) -> float:
    return max(0, until_ns - time.monotonic_ns()) / 1e9


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
    """Keeps at most ``jobs`` requests in flight, and matches answers to them. No I/O.

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
