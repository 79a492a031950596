"""The TCP connection to a controller: whole frames, every wait bounded by a deadline."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.options import S7Options
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


def named(error: BaseException, options: S7Options, *, opening: bool = False) -> ConnectorError | None:
    """Return a ConnectorError that explains a connection's error; None for other errors."""
    peer = options.peer
    if isinstance(error, TimeoutError):
        return ConnectorError(f"no answer within {options.timeout} ms from {peer}")
    if isinstance(error, ConnectionRefusedError):
        return ConnectorError(f"connection refused by {peer}")
    if isinstance(error, (EOFError, ConnectionError)):
        text = f"{peer} closed the connection"
        if opening:
            text += (
                f" during set-up: rack {options.rack}, slot {options.cpu_slot} may be wrong, all its connections in "
                "use, or it is not an S7 controller"
            )
        return ConnectorError(text)
    if isinstance(error, socket.gaierror):
        return ConnectorError(f"host name {options.host!r} cannot be resolved: {error.strerror}")
    if isinstance(error, OSError):
        return ConnectorError(f"{peer} cannot be reached: {error.strerror or error}")
    return None


class CloseOnError:
    """Context manager that closes a connection on any error, and explains the error."""

    def __init__(self, close: Callable[[], None], options: S7Options, *, opening: bool = False) -> None:
        self._close = close
        self._options = options
        self._opening = opening

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is not None:
            self._close()
            if (clear := named(error, self._options, opening=self._opening)) is not None:
                raise clear from None
