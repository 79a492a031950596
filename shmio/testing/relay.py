"""What a relay holds: pairs of connections, and in each direction bytes that wait until they are due."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections import deque

_MAX_QUEUED = 4 << 20  # bytes under way in one direction, beyond which the sender is left waiting
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: close with RST


class Link:
    """A client's connection and the one to the server on its behalf."""

    def __init__(self, client: socket.socket, server: socket.socket) -> None:
        self._sockets = (client, server)
        for end in self._sockets:
            end.setblocking(False)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.up = Pipe(self, client, server)
        self.down = Pipe(self, server, client)
        self.pipes = (self.up, self.down)

    @property
    def open(self) -> bool:
        """Whether bytes may still pass."""
        if self._sockets[0].fileno() >= 0 and all(pipe.finished for pipe in self.pipes):
            self.close()
        return self._sockets[0].fileno() >= 0

    def close(self, *, reset: bool = False) -> None:
        """Close both ends; ``reset``: as a crashed peer does."""
        for end in self._sockets:
            if end.fileno() >= 0 and reset:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            end.close()


class Pipe:
    """One direction of a link."""

    def __init__(self, link: Link, source: socket.socket, sink: socket.socket) -> None:
        self.link = link
        self.source, self.sink = source, sink
        self.partial = bytearray()  # of a frame to be edited
        self.due = bytearray()
        self.ended = False
        self.finished = False
        self.last_sent = 0
        self._later: deque[tuple[float, bytes]] = deque()
        self._queued = 0

    @property
    def hungry(self) -> bool:
        """Whether to take more from the source."""
        return not self.ended and self._queued < _MAX_QUEUED

    @property
    def next_s(self) -> float:
        """When the next bytes are due, on the monotonic clock; infinity if there are none."""
        return self._later[0][0] if self._later else float("inf")

    def enqueue(self, data: bytes, delay_s: float) -> None:
        """Take bytes that become due after a delay."""
        due_s = time.monotonic() + delay_s
        if self._later:
            due_s = max(due_s, self._later[-1][0])  # a shorter delay must not overtake
        self._later.append((due_s, data))
        self._queued += len(data)

    def collect_due(self, now_s: float) -> None:
        """Move to ``due`` what has waited long enough."""
        while self._later and self._later[0][0] <= now_s:
            self.due += self._later.popleft()[1]

    def end_when_drained(self) -> None:
        """Hand on the end of the stream after its last byte."""
        if self.ended and not self.due and not self._later and not self.finished:
            self.finished = True
            with contextlib.suppress(OSError):
                self.sink.shutdown(socket.SHUT_WR)

    def send(self, limit: int | None) -> None:
        """Send what is due, at most ``limit`` bytes."""
        self.last_sent = 0
        with contextlib.suppress(BlockingIOError):
            self.last_sent = self.sink.send(self.due if limit is None else self.due[:limit])
        del self.due[: self.last_sent]
        self._queued -= self.last_sent
