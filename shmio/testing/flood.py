"""A flood of gRPC calls to unknown methods.

This module sends raw HTTP/2, because client libraries refuse to send some of these calls.
"""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final

NOT_UTF8: Final = b"/x\xff\xfe/y"
UNKNOWN: Final = b"/shmio.v1.Shmio/NoSuchCall"
WINDOW: Final = 64
"""Number of concurrent calls on a connection. Every server accepts this number."""

_PREFACE: Final = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
_FIELDS: Final = {
    b":method": b"POST",
    b":scheme": b"http",
    b":authority": b"x",
    b"te": b"trailers",
    b"content-type": b"application/grpc",
}
_HEADERS, _END_STREAM, _END_HEADERS = 1, 1, 4
_LAST_STREAM: Final = 1 << 30
PATIENCE_S: Final = 60.0


class Flood:
    """Threads that send calls to unknown methods as fast as a server answers them.

    Each thread has its own connections.
    """

    def __init__(self, names: Sequence[bytes] = (NOT_UTF8, UNKNOWN), window: int = WINDOW) -> None:
        """Set the names to call, and the maximum number of unanswered calls on a connection."""
        self.answered = 0
        """Number of calls that were answered with a status."""
        self.lost = 0
        """Number of connections that the server closed."""
        self._names = names
        self._window = window
        self._connections: set[socket.socket] = set()
        self._over = threading.Event()
        self._lock = threading.Lock()

    @contextmanager
    def upon(
        self, target: tuple[str, int] | str, tls: ssl.SSLContext | None = None, threads: int = 2
    ) -> Iterator[None]:
        """Send calls to an address or a UNIX socket during a ``with`` block, with TLS if a context is given."""
        workers = [threading.Thread(target=self._run, args=(target, tls)) for _ in range(threads)]
        for worker in workers:
            worker.start()
        try:
            yield
        finally:
            self._over.set()
            with self._lock:
                for connection in self._connections:
                    _end(connection)  # or the event loop and a worker would wait for each other
            for worker in workers:
                worker.join()

    def _run(self, target: tuple[str, int] | str, tls: ssl.SSLContext | None) -> None:
        while not self._over.is_set():
            try:
                with connect(target, tls) as connection:
                    self._send(connection)
            except OSError:
                with self._lock:
                    self.lost += not self._over.is_set()
                self._over.wait(0.01)

    def _send(self, connection: socket.socket) -> None:
        with self._lock:
            self._connections = {other for other in self._connections if other.fileno() >= 0} | {connection}
        connection.sendall(_PREFACE)
        stream, open_calls = 1, 0
        frames = _frames(connection)
        while not self._over.is_set() and stream < _LAST_STREAM:
            calls = bytearray()
            while open_calls < self._window:
                calls += request(self._names[stream // 2 % len(self._names)], stream)
                stream, open_calls = stream + 2, open_calls + 1
            connection.sendall(calls)
            while open_calls > self._window // 2:
                kind, flags = next(frames)
                if kind == _HEADERS and flags & _END_STREAM:
                    open_calls -= 1
                    with self._lock:
                        self.answered += 1


def request(name: bytes, stream: int) -> bytes:
    """Return the HTTP/2 headers of a call without messages, uncompressed (RFC 7541, 6.2.2).

    ``name`` is the path of the method, and ``stream`` is the number of the stream.
    """
    block = b"".join(
        b"\0" + bytes((len(field),)) + field + bytes((len(value),)) + value
        for field, value in (_FIELDS | {b":path": name}).items()
    )
    head = len(block).to_bytes(3, "big") + bytes((_HEADERS, _END_HEADERS | _END_STREAM))
    return head + stream.to_bytes(4, "big") + block


@contextmanager
def connect(target: tuple[str, int] | str, tls: ssl.SSLContext | None = None) -> Iterator[socket.socket]:
    """Connect to a server, with TLS if a context is given."""
    if isinstance(target, str):
        plain = socket.socket(socket.AF_UNIX)
        plain.settimeout(PATIENCE_S)
        plain.connect(target)
    else:
        plain = socket.create_connection(target, PATIENCE_S)
    with plain if tls is None else tls.wrap_socket(plain, server_hostname="localhost") as connection:
        yield connection


def _end(connection: socket.socket) -> None:
    """Shut the socket down without a TLS close, so that the thread that reads it sees the end."""
    with suppress(OSError):
        socket.socket.shutdown(connection, socket.SHUT_RDWR)


def _frames(connection: socket.socket) -> Iterator[tuple[int, int]]:
    """Yield the kind and the flags of each HTTP/2 frame. Raise OSError if the server closes."""
    received = bytearray()
    while True:
        while len(received) < 9 or len(received) < 9 + int.from_bytes(received[:3], "big"):
            if not (data := connection.recv(1 << 16)):
                raise ConnectionResetError("the server ended the connection")
            received += data
        kind, flags = received[3], received[4]
        del received[: 9 + int.from_bytes(received[:3], "big")]
        yield kind, flags
