"""The TCP connection to a controller, and the window of requests in flight on it.

ISO 8073 (class 0) lets the peer divide a message into several data TPDUs, also empty ones; the last
has the mark EOT. RFC 1006 puts each TPDU into a frame. Controllers send empty TPDUs before or after
an answer. :meth:`Inbox.frame` joins the TPDUs of a message.

Every wait has a deadline. Reads, writes and questions share the connection, and the number of jobs
in flight that the controller granted. Every request in flight has a unique reference, by which an
answer finds the operation that sent the request.
"""

from __future__ import annotations

import select
import time
from collections import deque
from contextlib import suppress
from typing import Protocol

from shmio.connectors import tcp
from shmio.connectors.s7 import pdu
from shmio.errors import ConnectorError


class Inbox:
    """Received bytes, in a buffer of fixed size, and the messages in them. No I/O."""

    def __init__(self, frames: int, longest: int) -> None:
        """Create a buffer for ``frames`` frames of at most ``longest`` bytes."""
        self._data = memoryview(bytearray())
        self._start = self._end = 0  # range of the bytes received, but not yet taken
        self._parts = bytearray()  # parts of a message that still lacks its last TPDU
        self.reserve(frames, longest)

    def reserve(self, frames: int, longest: int) -> None:
        """Allocate a buffer for ``frames`` frames of at most ``longest`` bytes. It keeps what was received."""
        left = self._end - self._start
        data = memoryview(bytearray(frames * longest + left))
        data[:left] = self._data[self._start : self._end]
        self._longest = longest
        self._data = data
        self._start, self._end = 0, left

    def room(self) -> memoryview:
        """Return the free part of the buffer, which is not empty if all complete messages have been taken."""
        if self._start:
            left = self._end - self._start
            self._data[:left] = self._data[self._start : self._end]
            self._start, self._end = 0, left
        return self._data[self._end :]

    def add(self, count: int) -> None:
        """Note that ``count`` bytes were received into :meth:`room`."""
        self._end += count

    def frame(self) -> memoryview | None:
        """Return the next complete message as one frame, which is valid until the next ``room``.

        Skip empty TPDUs, and pushes, which answer no request. Return None if no message is complete.

        Raises:
            ConnectorError: The bytes are not frames, or a message is longer than a frame may be.

        """
        while (tpdu := self._tpdu()) is not None:
            frame: memoryview | None = tpdu
            if pdu.is_data(tpdu) and (self._parts or not pdu.is_whole(tpdu)):
                frame = self._join(tpdu)
            if frame is not None and not pdu.is_push(frame):
                return frame
        return None

    def _tpdu(self) -> memoryview | None:
        """Return the next complete frame; None if there is none."""
        left = self._end - self._start
        if left < 4:
            if left:
                pdu.check_first(self._data, self._start)
            return None
        length = pdu.frame_length(self._data, self._start, self._longest)
        if left < length:
            return None
        frame = self._data[self._start : self._start + length]
        self._start += length
        return frame

    def _join(self, tpdu: memoryview) -> memoryview | None:
        """Add a TPDU to its message. Return the message as a frame if the TPDU is its last one, and it has data."""
        self._parts += tpdu[pdu.FRAME_OVERHEAD :]
        if (most := self._longest - pdu.FRAME_OVERHEAD) < len(self._parts):
            raise ConnectorError(f"the controller sent a message of more than {most} bytes in several TPDUs")
        if not pdu.is_last(tpdu):
            return None
        whole = bytes(self._parts)
        self._parts.clear()
        return memoryview(pdu.data_frame(whole)) if whole else None


class Transport:
    """One TCP connection.

    Deadlines are times of CLOCK_MONOTONIC in ns. Methods meet them to within about 0.1 ms.
    """

    def __init__(self, host: str, port: int, timeout_ns: int) -> None:
        """Look up the host name, then connect; each of the two may take ``timeout_ns``.

        Raises:
            OSError: No connection could be opened.

        """
        places = tcp.look_up(host, port, timeout_ns / 1e9)
        self.deadline_ns = time.monotonic_ns() + timeout_ns
        """The time by which the connection must be open, CLOCK_MONOTONIC in ns."""
        self._socket = tcp.connect(places, timeout_ns / 1e9)
        self._socket.setblocking(False)
        self.taken = 0
        """Number of bytes that the kernel accepted in the last ``send``, even if ``send`` failed."""
        self.inbox = Inbox(1, 512)  # longer than any connection confirm

    def send(self, data: bytes | memoryview, deadline_ns: int) -> None:
        """Send all of ``data``.

        Answers that arrive in the meantime wait in the kernel's buffer.

        Raises:
            TimeoutError: The peer has not accepted the data by ``deadline_ns``.

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
        """Wait for data, and receive them. Return False if no data have come by ``until_ns``.

        Take all complete frames before the next call, so that there is room in the buffer.

        Raises:
            EOFError: The peer closed the connection.

        """
        ready, _, _ = select.select((self._socket,), (), (), _left_s(until_ns))
        if not ready:
            return False
        received = self._socket.recv_into(self.inbox.room())
        if not received:
            raise EOFError
        self.inbox.add(received)
        return True

    def next_frame(self, deadline_ns: int) -> memoryview:
        """Wait for a complete message, and return it as one frame.

        Raises:
            TimeoutError: The message has not arrived by ``deadline_ns``.

        """
        while (frame := self.inbox.frame()) is None:
            if time.monotonic_ns() >= deadline_ns or not self.receive(deadline_ns):
                raise TimeoutError
        return frame

    def close(self) -> None:
        """Close the socket, which also ends the session."""
        self._socket.close()


def _left_s(until_ns: int) -> float:
    return max(0, until_ns - time.monotonic_ns()) / 1e9


class Operation(Protocol):
    """A group of requests that together give one result, such as the read of a block."""

    @property
    def count(self) -> int:
        """Total number of requests."""

    sent: int
    """Number of requests that ``take`` has returned."""

    @property
    def complete(self) -> bool:
        """True if the operation expects no more answers."""

    def take(self, count: int, first: int) -> bytes | memoryview:
        """Return the next ``count`` requests as frames.

        Their references are 16-bit numbers from ``first`` on, which wrap.
        """

    def accept(self, index: int, frame: memoryview) -> None:
        """Process the answer to request number ``index``.

        Raises:
            ConnectorError: The answer does not match the request.

        """


class Window:
    """Limits the number of requests in flight to ``jobs``, and matches answers to requests. No I/O.

    References start at ``reference`` and wrap after 65535.
    """

    def __init__(self, jobs: int, reference: int) -> None:
        self.jobs = jobs
        self.reference = reference
        self._queue: deque[Operation] = deque()
        self._in_flight: dict[int, tuple[Operation, int]] = {}
        self._given: list[tuple[Operation, int]] = []  # of the last ``due``: operations, each with its first request

    @property
    def idle(self) -> bool:
        """True if no request is in flight."""
        return not self._in_flight

    @property
    def waiting(self) -> bool:
        """True if requests wait to be sent."""
        return bool(self._queue)

    def add(self, operation: Operation, *, urgent: bool = False) -> None:
        """Queue the requests of an operation, before all others if ``urgent`` is true."""
        if urgent:
            self._queue.appendleft(operation)
        else:
            self._queue.append(operation)

    def due(self) -> bytes | memoryview:
        """Return the requests that may be sent now, joined to one sequence of bytes; empty if there are none."""
        parts: list[bytes | memoryview] = []
        self._given.clear()
        while self._queue and (free := self.jobs - len(self._in_flight)) > 0:
            operation = self._queue[0]
            begin = operation.sent
            self._given.append((operation, begin))
            parts.append(operation.take(min(free, operation.count - begin), self.reference))
            for index in range(begin, operation.sent):
                self._in_flight[self.reference] = operation, index
                self.reference = (self.reference + 1) & 0xFFFF
            if operation.sent == operation.count:
                self._queue.popleft()
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def take_back(self) -> None:
        """Mark the requests that the last :meth:`due` returned as not sent, because the connection was lost."""
        for operation, begin in self._given:
            operation.sent = begin

    def accept(self, frame: memoryview) -> None:
        """Pass an answer to the operation that sent its request.

        Raises:
            ConnectorError: No request in flight has the answer's reference.

        """
        reference = pdu.reference_of(frame)
        owner = self._in_flight.pop(reference, None)
        if owner is None:
            pdu.check_answer(frame)  # raises a more precise error if the frame is not an answer
            raise ConnectorError(f"the controller answered a request that is not in flight (reference {reference})")
        owner[0].accept(owner[1], frame)
