"""Posts to real HTTP servers: those that work, and those that fail, hang, drip, redirect, or are false."""

from __future__ import annotations

import json
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import trustme

from shmio.config import Alert
from shmio.endpoints.alerts.sender import DeliveryError
from shmio.endpoints.alerts.webhook import Webhook
from tests.unit.endpoints.alerts.harness import notice

TIMEOUT_S = 30


class Server:
    """An HTTP server that answers with one status."""

    def __init__(
        self, status: int = 200, headers: dict[str, str] | None = None, tls: ssl.SSLContext | None = None
    ) -> None:
        self.requests: list[tuple[str, dict[str, str], bytes]] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.requests.append((self.path, dict(self.headers), body))
                self.send_response(status)
                for name, value in (headers or {}).items():
                    self.send_header(name, value)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.handle_error = lambda *_: None  # type: ignore[method-assign]  # a client that refuses our certificate
        if tls is not None:
            self._server.socket = tls.wrap_socket(self._server.socket, server_side=True)
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(TIMEOUT_S)


@contextmanager
def serving(
    status: int = 200, headers: dict[str, str] | None = None, tls: ssl.SSLContext | None = None
) -> Iterator[Server]:
    server = Server(status, headers, tls)
    try:
        yield server
    finally:
        server.close()


@contextmanager
def rude(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """Accept one connection, and let ``answer`` do with it what it likes. Yield the port."""
    listener = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        client, _ = listener.accept()
        with client:
            answer(client)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield listener.getsockname()[1]
    finally:
        thread.join(TIMEOUT_S)
        listener.close()
        assert not thread.is_alive()


def hook(port: int, path: str = "/hooks/s3cret", scheme: str = "http", **more: object) -> Webhook:
    return Webhook(Alert(name="hot", when="x", webhook=f"{scheme}://localhost:{port}{path}", **more))  # type: ignore[arg-type]


def test_a_notice_is_posted(tmp_path: Path) -> None:
    (tmp_path / "header").write_text("Authorization: Bearer t0ken\nX-Cell: a50\n")
    (tmp_path / "header").chmod(0o600)
    with serving(204) as server:
        hook(server.port, "/hook?x=1", webhook_header_file=str(tmp_path / "header")).deliver(notice())
        [(path, headers, body)] = server.requests
    assert path == "/hook?x=1"
    assert headers["Authorization"] == "Bearer t0ken"
    assert headers["X-Cell"] == "a50"
    assert headers["Content-Type"] == "application/json"
    assert json.loads(body) == json.loads(notice().json())


@pytest.mark.parametrize(
    ("status", "again"), [(500, True), (503, True), (429, True), (400, False), (404, False), (403, False)]
)
def test_a_server_that_refuses(status: int, again: bool) -> None:
    with serving(status) as server, pytest.raises(DeliveryError, match=str(status)) as raised:
        hook(server.port).deliver(notice())
    assert raised.value.again is again


def test_redirects_are_not_followed() -> None:
    with serving() as other, serving(307, {"Location": f"http://127.0.0.1:{other.port}/"}) as server:
        with pytest.raises(DeliveryError, match="redirects are not followed") as raised:
            hook(server.port).deliver(notice())
        assert not raised.value.again
        assert other.requests == []


def hang(client: socket.socket) -> None:
    while client.recv(65536):
        pass


def drip(client: socket.socket) -> None:
    client.settimeout(0.02)
    try:
        client.sendall(b"HTTP/1.1 200 OK\r\n")
        while True:
            client.sendall(b"X-Drip: 1\r\n")
            try:
                if not client.recv(65536):
                    return
            except TimeoutError:
                pass
    except OSError:
        pass


@pytest.mark.parametrize("answer", [hang, drip])
def test_a_server_has_limited_time(answer: Callable[[socket.socket], None], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("http.client._MAXHEADERS", 10**9)
    with rude(answer) as port, pytest.raises(DeliveryError, match=r"no answer within 0\.3 s") as raised:
        hook(port, webhook_timeout_s=0.3).deliver(notice())
    assert raised.value.again


@pytest.mark.parametrize(
    "answer",
    [b"", b"\xff\x00 nothing\r\n\r\n", b"HTTP/1.1 200 OK\r\n" + b"X: y\r\n" * 1000, b"HTTP/1.1 " + b"9" * 70000],
)
def test_a_server_that_speaks_something_else(answer: bytes) -> None:
    def send(client: socket.socket) -> None:
        client.recv(65536)
        client.sendall(answer)

    with rude(send) as port, pytest.raises(DeliveryError, match=r"HTTP|lost") as raised:
        hook(port).deliver(notice())
    assert raised.value.again


def test_nothing_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(DeliveryError, match="nothing listens") as raised:
        hook(port).deliver(notice())
    assert raised.value.again
    assert "s3cret" not in hook(port).text


def test_a_stop_ends_a_request() -> None:
    def stop(client: socket.socket) -> None:
        client.recv(65536)
        one.stop()
        hang(client)

    with rude(stop) as port:
        one = hook(port, webhook_timeout_s=TIMEOUT_S)
        with pytest.raises(DeliveryError):
            one.deliver(notice())


def test_certificates_are_checked(tmp_path: Path) -> None:
    authority, other = trustme.CA(), trustme.CA()
    for name, one in (("ca", authority), ("other", other)):
        one.cert_pem.write_to_path(tmp_path / name)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("localhost").configure_cert(context)
    with serving(tls=context) as server:
        hook(server.port, scheme="https", webhook_ca=str(tmp_path / "ca")).deliver(notice())
        assert len(server.requests) == 1
    for trusted in (str(tmp_path / "other"), None):
        with serving(tls=context) as server:
            with pytest.raises(DeliveryError, match="not trusted"):
                hook(server.port, scheme="https", webhook_ca=trusted).deliver(notice())
            assert server.requests == []


def test_a_secret_that_others_can_read_is_not_sent(tmp_path: Path) -> None:
    (tmp_path / "header").write_text("Authorization: Bearer t0ken\n")
    (tmp_path / "header").chmod(0o644)
    with serving() as server:
        with pytest.raises(DeliveryError, match="chmod 600") as raised:
            hook(server.port, webhook_header_file=str(tmp_path / "header")).deliver(notice())
        assert server.requests == []
    assert "t0ken" not in str(raised.value)
