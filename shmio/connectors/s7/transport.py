"""The connection to a controller: whole frames over TCP, every wait bounded by a deadline."""

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
    """One TCP connection. Deadlines are ns of CLOCK_MONOTONIC; ``select`` keeps them to some 0.1 ms."""

    def __init__(self, host: str, port: int, timeout_ns: int) -> None:
        """Connect, within ``timeout_ns`` (looking up a host name excepted); OSError if nobody is there."""
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        self.deadline_ns = time.monotonic_ns() + timeout_ns
        """Until when ``timeout_ns`` lasts."""
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
        """Bytes of the last ``send`` that are on their way, or were when it failed."""
        self.reserve(1, 512)  # more than any connection confirm

    def reserve(self, frames: int, longest: int) -> None:
        """Have room for so many frames of at most ``longest`` bytes; what has come must have been taken."""
        self._longest = longest
        self._inbox = memoryview(bytearray(frames * longest))
        self._start = self._end = 0  # of the bytes received, but not yet taken

    @property
    def left(self) -> int:
        """Bytes received, but not yet taken."""
        return self._end - self._start

    def send(self, data: bytes | memoryview, deadline_ns: int) -> None:
        """Send all of it. TimeoutError: the peer takes none.

        What it answers meanwhile waits in the kernel: with so few requests under way, it fits there.
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
        """Take what the socket has, once there is something; False: nothing came. EOFError: the peer closed.

        Whole frames are to be taken before the next call: what is left is then less than one, so there is always room.
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
        """Take the next frame out of what has come; None if it is not whole yet. Good until the next ``receive``."""
        if self._end - self._start < 4:
            return None
        length = pdu.frame_length(self._inbox, self._start, self._longest)
        if self._end - self._start < length:
            return None
        frame = self._inbox[self._start : self._start + length]
        self._start += length
        return frame

    def next_frame(self, deadline_ns: int) -> memoryview:
        """Wait for a whole frame; TimeoutError."""
        while (frame := self.frame()) is None:
            if not self.receive(deadline_ns):
                raise TimeoutError
        return frame

    def close(self) -> None:
        """Close the socket. In class 0 of the transport protocol, that alone ends the session."""
        self._socket.close()


def _left_s(until_ns: int) -> float:
    return max(0, until_ns - time.monotonic_ns()) / 1e9


def named(error: BaseException, options: S7Options, *, opening: bool = False) -> ConnectorError | None:
    """Say for people what happened to a connection; None if the error is not of a connection."""
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
    """Closes a connection on any way out of a ``with`` block but the good one, and names the error for people."""

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
