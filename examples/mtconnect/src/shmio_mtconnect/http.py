"""Requests to an agent: for one document, or for an endless multipart stream of documents, all within limits."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final
from urllib.parse import urlsplit

from shmio.connectors import tcp
from shmio.errors import ConnectorError
from shmio_mtconnect.documents import MAX_DOCUMENT_BYTES, DevicesDocument, StreamsDocument

_CHUNK: Final = 1 << 16
MAX_LINE: Final = 1 << 12
"""Longest line in the header of a part, in bytes."""
MAX_LINES: Final = 32


def _connected(address: tuple[str, int], timeout_s: float, _source: object) -> socket.socket:
    return tcp.connect(tcp.look_up(*address, timeout_s), timeout_s)


class Exchange:
    """One request on one connection, and its answer.

    Within ``answer_within`` there is one deadline for everything, even for an answer that arrives byte by byte.
    """

    def __init__(self, url: str, timeout_ms: int) -> None:
        parts = urlsplit(url)
        self.peer = parts.netloc.rpartition("@")[2]
        self._prefix = parts.path.rstrip("/")
        self._timeout_ms = timeout_ms
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        self._connection = kind(parts.hostname or "", parts.port, timeout=timeout_ms / 1000)
        # As http.client opens its connections, but with a time-out for the look-up of the name.
        self._connection._create_connection = _connected  # type: ignore[attr-defined]
        self._answer: http.client.HTTPResponse | None = None
        self._socket: socket.socket | None = None
        self._closed = False
        self._late = False

    @contextmanager
    def answer_within(self) -> Iterator[None]:
        """Cut the connection at the time-out, and turn all errors into ConnectorError."""
        self._late = False

        def cut() -> None:
            self._late = True
            self._shut()

        timer = threading.Timer(self._timeout_ms / 1000, cut)
        timer.daemon = True
        timer.start()
        try:
            with self.faults():
                yield
        except ConnectorError:
            if self._late:
                raise ConnectorError(f"no answer from {self.peer} within {self._timeout_ms} ms") from None
            raise
        finally:
            timer.cancel()

    @contextmanager
    def faults(self) -> Iterator[None]:
        """Turn errors of the connection into ConnectorError."""
        try:
            yield
        except TimeoutError:
            raise ConnectorError(f"no answer from {self.peer} within {self._timeout_ms} ms") from None
        except OSError as error:
            raise ConnectorError(f"connection to {self.peer}: {error.strerror or error}") from None
        except (http.client.HTTPException, ValueError, AttributeError) as error:  # the last: closed meanwhile
            raise ConnectorError(f"{self.peer} does not answer as an MTConnect agent: {_brief(error)}") from None

    def begin(self, request: str) -> None:
        """Send a request, and receive the headers of its answer. Call it within ``answer_within``."""
        self._connection.connect()
        self._socket = self._connection.sock
        if self._closed or self._late:  # there was no socket yet to be shut
            raise ConnectorError(f"the connection to {self.peer} was closed")
        self._connection.request("GET", f"{self._prefix}/{request}", headers={"Accept": "text/xml, application/xml"})
        self._answer = self._connection.getresponse()

    def document(self, request: str, into: DevicesDocument | StreamsDocument) -> None:
        """Request a document, and parse it."""
        with self.answer_within():
            self.begin(request)
            answer = self._opened()
            self._check(answer, streamed=False)
            while (data := answer.read1(_CHUNK)) and not self._late:  # parsing takes time, too
                into.feed(data)
            if answer.length or self._late:
                raise ConnectorError(f"{self.peer} has closed the connection in the middle of an answer")
            into.finish()

    def parts(self) -> Iterator[bytes]:
        """Yield the parts of a multipart answer as they arrive. It ends only by ConnectorError."""
        with self.faults():
            answer = self._opened()
            boundary = self._check(answer, streamed=True)
            reader = _Reader(answer, self.peer)
            while True:
                yield reader.part(boundary)

    def keep_waiting(self, timeout_s: float) -> None:
        """Set how long the stream may be silent."""
        with self.faults():
            if self._socket is not None:
                self._socket.settimeout(timeout_s)

    def close(self) -> None:
        """Close the connection. Any thread may call it. A thread that waits for an answer then ends."""
        self._closed = True
        self._shut()
        with suppress(OSError):
            self._connection.close()

    def _shut(self) -> None:
        if self._socket is not None:
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def _opened(self) -> http.client.HTTPResponse:
        if self._answer is None:
            raise ConnectorError(f"not connected to {self.peer}")
        return self._answer

    def _check(self, answer: http.client.HTTPResponse, *, streamed: bool) -> bytes:
        """Refuse an answer of the wrong kind. Return the boundary of a multipart answer."""
        kind = answer.headers.get_content_type()
        if streamed and kind == "multipart/x-mixed-replace":
            boundary = answer.headers.get_param("boundary")
            if isinstance(boundary, str) and boundary:
                return b"--" + boundary.encode("ascii", "replace")
        elif not streamed and kind in ("text/xml", "application/xml"):
            return b""
        if kind in ("text/xml", "application/xml"):  # the agent's own error says more
            body = StreamsDocument(())
            while data := answer.read1(_CHUNK):
                body.feed(data)
            body.finish()
        raise ConnectorError(f"{self.peer} answers {answer.status} with {kind}: is it an MTConnect agent?")


class _Reader:
    """Splits a multipart answer into its parts."""

    def __init__(self, answer: http.client.HTTPResponse, peer: str) -> None:
        self._answer, self._peer = answer, peer
        self._data = bytearray()

    def part(self, boundary: bytes) -> bytes:
        """Return the next part's document."""
        line = self._line()
        while not line:
            line = self._line()
        if line != boundary:
            if line == boundary + b"--":
                raise ConnectorError(f"{self._peer} has ended the stream")
            raise ConnectorError(f"{self._peer} sends {line[:40]!r} in the stream where a part begins")
        length = None
        for _ in range(MAX_LINES):
            line = self._line()
            if not line:
                break
            key, _, value = line.partition(b":")
            if key.strip().lower() == b"content-length":
                length = value.strip()
        else:
            raise ConnectorError(f"{self._peer} sends a part with more than {MAX_LINES} headers")
        if length is None or not length.isdigit() or len(length) > 9 or int(length) > MAX_DOCUMENT_BYTES:
            raise ConnectorError(
                f"{self._peer} sends a part of {(length or b'unknown')[:20].decode('ascii', 'replace')} bytes; "
                f"expected its Content-length, at most {MAX_DOCUMENT_BYTES}"
            )
        size = int(length)
        while len(self._data) < size:
            self._more()
        found = bytes(self._data[:size])
        del self._data[:size]
        return found

    def _line(self) -> bytes:
        while (end := self._data.find(b"\n", 0, MAX_LINE)) < 0:
            if len(self._data) >= MAX_LINE:
                raise ConnectorError(f"{self._peer} sends a header of more than {MAX_LINE} bytes in the stream")
            self._more()
        line = bytes(self._data[:end])
        del self._data[: end + 1]
        return line.rstrip(b"\r")

    def _more(self) -> None:
        data = self._answer.read1(_CHUNK)
        if not data:
            raise ConnectorError(f"{self._peer} has closed the connection of the stream")
        self._data += data


def _brief(error: Exception) -> str:
    return f"{type(error).__name__} {error}"[:200]
