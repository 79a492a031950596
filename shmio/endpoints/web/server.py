"""The HTTP server. It limits connections and requests, and adds security headers to all answers."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn import Config
from uvicorn import Server as Uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from shmio.config import Address
from shmio.errors import EndpointError
from shmio.logs import log_loop_errors
from shmio.wording import cannot_listen

MAX_CONNECTIONS: Final = 512
"""Maximum number of connections. If there are more, the one that has been without a request longest is closed."""
MAX_MESSAGE_BYTES: Final = 64 << 10
"""Maximum size of a message that a page sends over its WebSocket."""
SEND_BUFFER_BYTES: Final = 64 << 10
"""Size of the kernel's send buffer for each client. In a larger one, old data would wait for slow clients."""
PING_S: Final = 20.0
"""Interval in s at which a page is pinged, and the time in s in which it must answer a ping."""
REQUEST_S: Final = 10.0
"""Time in s in which a client must send its first request, and each later request from its first byte on."""
IDLE_S: Final = 75
"""Time in s after which an idle connection is closed. Between scrapes, Prometheus keeps its connection."""
UNREAD_S: Final = 20.0
"""Time in s after which a connection ends whose client reads nothing, or does not end a connection that is closing."""
MAX_HEADER_BYTES: Final = 16 << 10
BACKLOG: Final = 64
STOP_S: Final = 1
"""Time in s that answers have to end when the server stops."""
_HEADERS: Final = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'"),
    (b"cache-control", b"no-store"),
)
"""The headers of each answer."""
_TCP_CLOSE: Final = 7  # tcp_states.h of Linux: the client has reset the connection
_TCP_CLOSE_WAIT: Final = 8  # the client has closed its side
_log = logging.getLogger("shmio.web")


@dataclass
class Counters:
    """Counts requests, refusals and bytes of answers since the start, and open connections."""

    requests: int = 0
    refused: int = 0
    connections: int = 0
    answer_bytes: int = 0
    """Number of bytes in the bodies of answers to HTTP requests."""


class _Connection(asyncio.Protocol):
    """What both kinds of connections have in common: they end if their clients do not read, or do not close."""

    transport: asyncio.Transport
    loop: asyncio.AbstractEventLoop
    unread_s: float | None = None
    """The event loop's time in s since which the client has not read what was sent; None: it reads."""
    closing_s: float | None = None

    def pause_writing(self) -> None:
        """Remember since when the client reads nothing."""
        super().pause_writing()
        self.unread_s = self.loop.time()

    def resume_writing(self) -> None:
        """Note that the client reads again."""
        super().resume_writing()
        self.unread_s = None

    def review(self) -> None:
        """End the connection if its client has not read or closed it for too long. Call this about once a second."""
        now_s = self.loop.time()
        if self.closing_s is None and (self.transport.is_closing() or getattr(self, "close_sent", False)):
            self.closing_s = now_s
        if any(since_s is not None and now_s - since_s >= UNREAD_S for since_s in (self.unread_s, self.closing_s)):
            self.transport.abort()


class _WebSocket(_Connection, WebSocketsSansIOProtocol):
    """A WebSocket. Its page ends with the connection, whatever the page waits for."""

    _page: asyncio.Task[None] | None = None

    def connection_lost(self, exc: Exception | None) -> None:
        """End the page."""
        super().connection_lost(exc)
        if self._page is not None:
            self._page.cancel()

    def pause_writing(self) -> None:
        """Read nothing while the client reads nothing. Otherwise, answers to pings would fill the memory."""
        super().pause_writing()
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        """Read again, unless the page has not read the last message yet."""
        super().resume_writing()
        if not self.read_paused:
            self.transport.resume_reading()

    def review(self) -> None:
        """End the connection also if its client has left. asyncio does not see that while the page reads nothing."""
        super().review()
        if self.read_paused:
            state = self.transport.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]
            if state in (_TCP_CLOSE, _TCP_CLOSE_WAIT):
                self.transport.abort()

    def send_receive_event_to_app(self) -> None:
        """Hand a message to the page. A text that is not UTF-8 ends the connection (RFC 6455, section 8.1)."""
        if self.curr_msg_data_type == "text" and not self.close_sent:
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError:
                _log.warning("a page sent text that is not UTF-8, so its connection is closed")
                self.frames = []
                self.conn.send_close(1007)
                self.handle_parser_exception()
                return
        super().send_receive_event_to_app()

    async def run_asgi(self) -> None:
        """Run the page until it ends, or until the connection is lost."""
        self._page = asyncio.current_task()
        try:
            await self.app(self.scope, self.receive, self.send)
        except (ClientDisconnected, asyncio.CancelledError):
            pass
        except Exception as error:  # noqa: BLE001  a page must not end the server
            _log_failure("a page", error)
            self.send_500_response()
        finally:
            self._page = None
        if self.close_timer is None:
            self.transport.close()


class _Protocol(_Connection, H11Protocol):
    """A connection that is closed if its client does not send whole requests in time."""

    counters: Counters
    _deadline: asyncio.TimerHandle | None = None
    _quiet_s: float | None = None
    """The event loop's time in s since which no request is in progress; None: a request is in progress."""

    def connection_made(self, transport: Any) -> None:
        """Accept the connection. If there are now too many connections, close one of them."""
        super().connection_made(transport)
        self._quiet_s = self.loop.time()
        self._set_deadline()
        if len(self.connections) > MAX_CONNECTIONS:
            self.counters.refused += 1
            self._longest_quiet().abort()

    def _longest_quiet(self) -> asyncio.Transport:
        """Return the connection to close: one that is closing, or else the one longest without a request or reading."""
        for other in self.connections:
            if getattr(other, "close_sent", False) or other.transport.is_closing():
                return other.transport
        quiet = [
            (since_s, one.transport)
            for one in self.connections
            if isinstance(one, _Protocol)
            for since_s in (one._quiet_s, one.unread_s)
            if since_s is not None
        ]
        return min(quiet, key=itemgetter(0))[1]

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Hand the connection over to a page's WebSocket, without a deadline."""
        self._clear_deadline()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._clear_deadline()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Process bytes of a request. The first byte starts the request's deadline."""
        if self._deadline is None and (self.cycle is None or self.cycle.response_complete):
            self._set_deadline()
        super().data_received(data)
        if self.cycle is not None and not self.cycle.response_complete and not self.cycle.more_body:
            self._quiet_s = None
            self._clear_deadline()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self._quiet_s = self.loop.time()
        self._clear_deadline()
        super().on_response_complete()

    def _set_deadline(self) -> None:
        self._deadline = self.loop.call_later(REQUEST_S, self._expire)

    def _clear_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _expire(self) -> None:
        self._deadline = None
        self.counters.refused += 1
        self.transport.abort()


class _Guarded:
    """Refuses requests for other hosts' names or from other servers' pages, and adds headers to every answer.

    A foreign web page can make a browser send requests to this server under a name of the page's own (DNS
    rebinding). Then the Host header has that name, so only names of this server are accepted.
    """

    def __init__(self, app: ASGIApp, names: frozenset[str], counters: Counters) -> None:
        self._app, self._names, self._counters = app, names, counters

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on to the application, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            return
        self._counters.requests += 1
        hosts = [value for name, value in scope["headers"] if name == b"host"]
        origins = [value for name, value in scope["headers"] if name == b"origin"]
        known = len(hosts) == 1 and self.knows(hosts[0].decode("latin-1"))
        if scope["type"] == "websocket":
            if known and _same_origin(origins, hosts[0], secure=scope["scheme"] == "wss"):
                await self._app(scope, receive, send)
            else:
                self._counters.refused += 1
                await send({"type": "websocket.close", "code": 1008})  # before accept(): the client gets the status 403
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name for name, _ in message["headers"]}
                message["headers"] = [
                    *message["headers"], *((name, value) for name, value in _HEADERS if name not in given)
                ]  # fmt: skip
            elif message["type"] == "http.response.body":
                self._counters.answer_bytes += len(message.get("body", b""))
            await send(message)

        async def refuse(status: int, text: bytes) -> None:
            self._counters.refused += 1
            start = {"type": "http.response.start", "status": status, "headers": [(b"content-type", b"text/plain")]}
            await with_headers(start)
            await with_headers({"type": "http.response.body", "body": text})

        if not known:
            text = b"this server has another name; use its address in listen, or add the name to hosts beside it\n"
            await refuse(421, text)
        elif scope["method"] not in ("GET", "HEAD") and not _same_origin(
            origins, hosts[0], secure=scope["scheme"] == "https"
        ):
            await refuse(403, b"this request comes from a page of another server\n")
        else:
            try:
                await self._app(scope, receive, with_headers)
            except OSError as error:  # such as: no descriptor is free
                _log_failure(f"{scope['method']} {scope['path'][:80]!r}", error)
                await refuse(503, b"the server cannot do this now; its log has the reason\n")

    def knows(self, host: str) -> bool:
        """Return whether a Host header names this server: an IP address, ``localhost``, or a configured name."""
        name = host.rpartition(":")[0] if ":" in host and not host.endswith("]") else host
        name = name.removeprefix("[").removesuffix("]").lower()
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        return True


def _same_origin(origins: list[bytes], host: bytes, *, secure: bool) -> bool:
    """Return whether a request comes from a page of this server, or from a program other than a browser.

    Browsers name the page that sends a request in the Origin header (RFC 6454, section 7).
    """
    return not origins or origins == [(b"https://" if secure else b"http://") + host.lower()]


def _log_failure(what: str, error: Exception) -> None:
    """Log why a request or a page failed; with a traceback only if it may be an error in the program."""
    expected = isinstance(error, OSError)
    _log.error("%s failed: %s", what, error, exc_info=None if expected else error)


class _Server(Uvicorn):
    """A server that leaves signals to the worker."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.ready = asyncio.Event()
        """Set once connections are accepted."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to accept connections."""
        await super().startup(sockets)
        self.ready.set()

    async def on_tick(self, counter: int) -> bool:
        """End the connections whose clients do not read or close. uvicorn calls this ten times a second."""
        if counter % 10 == 0:
            for connection in tuple(self.server_state.connections):
                if isinstance(connection, _Connection):
                    connection.review()
        return await super().on_tick(counter)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Install no signal handlers, because the worker has its own."""
        yield


class HttpServer:
    """Serves an application on one address. Use it only in the event loop's thread."""

    def __init__(
        self,
        app: ASGIApp,
        address: Address,
        *,
        hosts: tuple[str, ...] = (),
        sockets: bool = False,
        certificate: str | None = None,
        key: str | None = None,
    ) -> None:
        """Create the server; :meth:`start` starts to listen.

        Args:
            app: The application.
            address: Where to listen.
            hosts: Names by which clients may address the server, besides IP addresses, ``localhost`` and the name in
                ``address``.
            sockets: Whether the application has WebSockets.
            certificate: PEM file of the certificate for TLS.
            key: PEM file of the certificate's key.

        """
        self.address = address
        self._counters = Counters()
        names = frozenset(name.lower() for name in ("localhost", address.host, *hosts))
        protocol = type("Protocol", (_Protocol,), {"counters": self._counters})
        config = Config(
            _Guarded(app, names, self._counters),
            http=protocol,
            ws=_WebSocket if sockets else "none",
            ws_max_size=MAX_MESSAGE_BYTES,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PING_S,
            ws_per_message_deflate=False,
            loop="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            backlog=BACKLOG,
            timeout_keep_alive=IDLE_S,
            timeout_graceful_shutdown=STOP_S,
            h11_max_incomplete_event_size=MAX_HEADER_BYTES,
            ssl_certfile=certificate,
            ssl_keyfile=key,
            ssl_version=ssl.PROTOCOL_TLS_SERVER,
        )
        self._server = _Server(config)
        self._serving: asyncio.Task[None] | None = None

    @property
    def counters(self) -> Counters:
        """What the server has counted until now."""
        self._counters.connections = len(self._server.server_state.connections)
        return self._counters

    async def start(self) -> None:
        """Start to listen.

        Raises:
            EndpointError: The address cannot be used.
        """
        log_loop_errors(asyncio.get_running_loop())
        family = socket.AF_INET6 if ":" in self.address.host else socket.AF_INET
        listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # else asyncio sets no TCP_NODELAY
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)  # connections inherit it
        try:
            listening.bind((self.address.host, self.address.port))
            listening.listen(BACKLOG)
        except OSError as error:
            listening.close()
            raise EndpointError(cannot_listen(self.address, error)) from None
        self.port: int = listening.getsockname()[1]
        self._serving = asyncio.get_running_loop().create_task(self._server.serve([listening]))
        ready = asyncio.get_running_loop().create_task(self._server.ready.wait())
        await asyncio.wait({ready, self._serving}, return_when=asyncio.FIRST_COMPLETED)
        if self._serving.done():  # uvicorn could not start
            ready.cancel()
            listening.close()
            await self._serving  # raises the reason
            raise EndpointError(f"cannot serve HTTP on {self.address}: the server ended while it started")

    async def stop(self) -> None:
        """Stop listening, and end all connections."""
        self._server.should_exit = True
        if self._serving is not None:
            await self._serving
