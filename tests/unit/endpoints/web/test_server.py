"""The HTTP server with requests for foreign names, and with clients that misbehave."""

from __future__ import annotations

import asyncio
import socket
from contextlib import ExitStack

import pytest

from shmio.config import Address
from shmio.endpoints.web import server
from shmio.endpoints.web.server import HttpServer
from shmio.errors import EndpointError
from shmio.segment import Segment
from tests.unit.endpoints.web.harness import TIMEOUT_S, Served, served


def connected(endpoint: Served) -> socket.socket:
    return socket.create_connection(("127.0.0.1", endpoint.server.port), timeout=TIMEOUT_S)


def rest(connection: socket.socket) -> bytes:
    """Return all that the server sends until it closes the connection."""
    received = b""
    try:
        while data := connection.recv(4096):
            received += data
    except ConnectionResetError:
        pass
    return received


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200), ("127.0.0.1:9464", 200), ("[::1]:9464", 200), ("[::1]", 200), ("localhost:1", 200),
        ("LOCALHOST", 200), ("cell.lan", 200), ("evil.example", 421), ("127.0.0.1.evil.example", 421),
        ("localhost.evil.example:80", 421), ("", 421),
    ],
)  # fmt: skip
def test_only_names_of_the_server_are_answered(segment: Segment, host: str, status: int) -> None:
    with served(segment, hosts=["Cell.LAN"]) as endpoint:
        found, headers, _ = endpoint.get(headers={"Host": host})
        assert found == status
        assert headers["x-content-type-options"] == "nosniff"
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "access-control-allow-origin" not in headers


def test_paths_and_methods(segment: Segment) -> None:
    with served(segment) as endpoint:
        assert endpoint.get()[1]["content-type"].startswith("text/plain; version=")
        assert "/metrics" in endpoint.get("/")[2]
        assert endpoint.get("/etc/passwd")[0] == 404
        assert endpoint.get("/metrics", method="POST")[0] == 405
        assert endpoint.get("/metrics", method="HEAD")[2] == ""


@pytest.mark.parametrize(
    "request_",
    [
        b"",
        b"G",
        b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n",
    ],
)
def test_a_client_that_sends_no_whole_request_is_disconnected(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, request_: bytes
) -> None:
    monkeypatch.setattr(server, "REQUEST_S", 0.05)
    with served(segment) as endpoint, connected(endpoint) as client:
        client.sendall(request_)
        assert rest(client) == b""
        assert endpoint.server.counters.refused == 1


def test_a_next_request_has_the_same_deadline(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "REQUEST_S", 0.2)
    with served(segment) as endpoint, connected(endpoint) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        received = b""
        while not received.endswith(b"Prometheus\n"):
            received += client.recv(4096)
        client.sendall(b"GET")
        assert rest(client) == b""
        assert endpoint.server.counters.refused == 1


def test_answers_are_sent_at_once(segment: Segment) -> None:
    """Otherwise, the kernel holds the second part of an answer back until the first is acknowledged, up to 40 ms."""
    with served(segment) as endpoint, connected(endpoint) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert client.recv(4096)
        [connection] = endpoint.server._server.server_state.connections
        accepted = connection.transport.get_extra_info("socket")
        assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_oldest_of_too_many_connections_is_closed(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 3)
    with served(segment) as endpoint, ExitStack() as stack:
        clients = [stack.enter_context(connected(endpoint)) for _ in range(4)]
        assert rest(clients[0]) == b""  # the one that has waited longest
        clients[3].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert b"200 OK" in clients[3].recv(4096)


@pytest.mark.parametrize(
    "request_",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 100_000,
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" * 30 + b"\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
    ],
)
def test_garbage_is_refused(segment: Segment, request_: bytes) -> None:
    with served(segment) as endpoint, connected(endpoint) as client:
        client.sendall(request_)
        assert client.recv(4096).startswith((b"HTTP/1.1 400", b"HTTP/1.1 421"))
        assert endpoint.get("/")[0] == 200


def test_a_used_address_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(EndpointError, match=f"cannot listen on 127.0.0.1:{port}: Address already in use"):
            asyncio.run(HttpServer(lambda *_: None, Address("127.0.0.1", port)).start())  # type: ignore[arg-type]
