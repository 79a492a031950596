"""The web page over real sockets, used as a browser uses it."""

from __future__ import annotations

import asyncio
import http.client
import json
import socket
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection

from shmio.config import Address
from shmio.config.credentials import Secret, digest
from shmio.endpoints import wrong_tokens
from shmio.endpoints.grpc.server.access import NEEDS
from shmio.endpoints.web import app, page, sessions
from shmio.endpoints.web.app import PageApp
from shmio.endpoints.web.measurements import Measurements
from shmio.endpoints.web.served import Served
from shmio.endpoints.web.server import MAX_MESSAGE_BYTES, HttpServer
from shmio.endpoints.web.sessions import COOKIE, Sessions
from shmio.endpoints.web.tabs import TABS
from shmio.local.attach import Attachment
from shmio.segment import Segment
from tests.unit.endpoints.web.harness import TIMEOUT_S

TOKEN = "a-token-of-thirty-two-characters"
UPGRADE = (
    b"GET /socket HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
SECRETS = (Secret("ann", frozenset({"read"}), digest(TOKEN.encode())),)


class Pages:
    """A server of the page, and a browser's requests to it."""

    def __init__(self, server: HttpServer, instance: str, app: PageApp, loop: asyncio.AbstractEventLoop) -> None:
        self.port = server.port
        self.cookie = COOKIE.format(instance)
        self._server, self._app, self._loop = server, app, loop

    def waiting(self) -> int:
        """Return the number of answers to wrong tokens that are being delayed."""
        return len(self._app._wrong._waiting)

    def held(self) -> dict[str, int]:
        """Return what the server holds for its clients: slots, connections, tasks, and this process's descriptors."""

        async def count() -> dict[str, int]:
            return {
                "pages": len(self._app._pages),
                "silent": len(self._app._silent),
                "connections": self._server.counters.connections,
                "tasks": len(asyncio.all_tasks()) - 1,
                "wrong": self.waiting(),
                "uploads": len(self._app._uploads._receiving),
            }

        found = asyncio.run_coroutine_threadsafe(count(), self._loop).result(TIMEOUT_S)
        return found | {"descriptors": len(list(Path("/proc/self/fd").iterdir()))}

    def request(
        self, method: str, path: str, body: str | bytes | None = None, **headers: str
    ) -> tuple[int, http.client.HTTPMessage, str]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=TIMEOUT_S)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            return answer.status, answer.headers, answer.read().decode()
        finally:
            connection.close()

    def sign_in(self, token: str, **headers: str) -> str:
        """Return the cookie of a new session."""
        _, answer, _ = self.request("POST", "/session", json.dumps({"token": token}), **headers)
        name, _, value = answer["set-cookie"].partition(";")[0].partition("=")
        assert name == self.cookie
        return value

    def open(self, cookie: str | None = None, **more: Any) -> ClientConnection:
        headers = {} if cookie is None else {"Cookie": f"{self.cookie}={cookie}"}
        return connect(f"ws://127.0.0.1:{self.port}/socket", additional_headers=headers, open_timeout=TIMEOUT_S, **more)


@contextmanager
def pages(
    segment: Segment,
    secrets: Sequence[Secret] = (),
    roles: Sequence[str] = ("read",),
    folders: Mapping[str, str] | None = None,
    recordings: Path | None = None,
    scene: Mapping[str, Any] | None = None,
    config_file: str = "",
    fabric: Mapping[str, Any] | None = None,
) -> Iterator[Pages]:
    """Serve the page of a segment on a free port."""
    measurements = Measurements(segment)
    with Segment.open(segment.instance, writable=True) as mapped:
        folder = None if recordings is None else str(recordings)
        shown = Served(segment, Attachment(mapped), measurements, folders or {}, config_file, folder, scene, fabric)
        served = PageApp(shown, Sessions(secrets, roles), TABS, secure=False)
        server = HttpServer(served.app(measurements, ()), Address("127.0.0.1", 0), sockets=True)
        loop = asyncio.new_event_loop()
        thread = threading.Thread(target=loop.run_forever)
        thread.start()
        try:
            asyncio.run_coroutine_threadsafe(server.start(), loop).result(TIMEOUT_S)
            yield Pages(server, segment.instance, served, loop)
        finally:
            asyncio.run_coroutine_threadsafe(server.stop(), loop).result(TIMEOUT_S)
            loop.call_soon_threadsafe(loop.stop)
            thread.join()
            loop.close()


def said(browser: Connection, call: str, **given: Any) -> dict[str, Any]:
    """Make a call, and return its answer."""
    browser.send(json.dumps({"id": 7, "call": call, "with": given}))
    while (message := json.loads(browser.recv(TIMEOUT_S))).get("id") != 7:
        pass
    return dict(message)


def test_page_and_its_files_come_from_this_server_alone(segment: Segment) -> None:
    with pages(segment) as server:
        for path, kind in (("/", "text/html"), ("/main.js", "text/javascript"), ("/style.css", "text/css")):
            status, headers, text = server.request("GET", path)
            assert (status, headers["content-type"]) == (200, f"{kind}; charset=utf-8")
            assert "script-src 'self'" in headers["content-security-policy"]
            assert "http:" not in text
        assert server.request("GET", "/../app.py")[0] == 404
        assert server.request("GET", "/metrics")[0] == 200


def test_overview_comes_unasked(segment: Segment) -> None:
    with pages(segment) as server, server.open() as browser:
        assert said(browser, "overview.follow") == {"id": 7, "result": None}
        for _ in range(2):
            message = json.loads(browser.recv(TIMEOUT_S))
            assert (message["topic"], message["data"]["instance"]) == ("overview", segment.instance)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:{port}"])
def test_pages_of_other_servers_get_nothing(segment: Segment, origin: str) -> None:
    with pages(segment, SECRETS) as server:
        origin = origin.format(port=server.port)
        with pytest.raises(InvalidStatus) as refused:
            server.open(origin=origin)
        assert refused.value.response.status_code == 403
        body = json.dumps({"token": TOKEN})
        assert server.request("POST", "/session", body, Origin=origin)[0] == 403
        assert server.request("DELETE", "/session", Origin=origin)[0] == 403
        own = f"http://127.0.0.1:{server.port}"
        assert server.request("POST", "/session", body, Origin=own)[0] == 200


def test_name_of_another_host_gets_nothing(segment: Segment) -> None:
    with pages(segment) as server:
        assert server.request("GET", "/", Host="evil.example")[0] == 421
        with pytest.raises(InvalidStatus):
            connect("ws://evil.example/socket", sock=socket.create_connection(("127.0.0.1", server.port)))


def test_token_opens_the_page_until_the_user_signs_out(segment: Segment) -> None:
    with pages(segment, SECRETS, roles=()) as server:
        with pytest.raises(InvalidStatus):
            server.open()
        assert server.request("POST", "/session", json.dumps({"token": "wrong"}))[0] == 403
        status, headers, text = server.request("POST", "/session", json.dumps({"token": TOKEN}))
        assert (status, json.loads(text)["name"], json.loads(text)["roles"]) == (200, "ann", ["read"])
        cookie = headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        value = cookie.partition(";")[0].partition("=")[2]
        with server.open(value) as browser:
            assert said(browser, "registers.rows", first=0, count=0)["result"]["rows"] == []
            assert server.request("DELETE", "/session", Cookie=f"{server.cookie}={value}")[0] == 200
            with pytest.raises(ConnectionClosed):  # a stolen cookie's page as well
                browser.recv(TIMEOUT_S)
        with pytest.raises(InvalidStatus):
            server.open(value)


def test_page_ends_with_its_session(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "MAX_AGE_S", 0.5)
    with pages(segment, SECRETS, roles=()) as server:
        cookie = server.sign_in(TOKEN)
        with server.open(cookie) as browser:
            assert said(browser, "registers.rows", first=0, count=0)["result"]["rows"] == []
            with pytest.raises(ConnectionClosed, match="the session has ended"):
                browser.recv(TIMEOUT_S)
        with pytest.raises(InvalidStatus):
            server.open(cookie)


def test_second_sign_in_ends_the_first(segment: Segment) -> None:
    with pages(segment, SECRETS, roles=()) as server:
        first = server.sign_in(TOKEN)
        assert server.sign_in(TOKEN, Cookie=f"{server.cookie}={first}") != first
        with pytest.raises(InvalidStatus):
            server.open(first)


def test_figures_need_the_role_read(segment: Segment) -> None:
    with pages(segment, SECRETS, roles=()) as server:
        status, headers, text = server.request("GET", "/metrics")
        assert (status, headers["www-authenticate"]) == (401, "Bearer")
        assert "shmio_" not in text
        assert server.request("GET", "/metrics", Authorization="Bearer wrong")[0] == 401
        assert server.request("GET", "/metrics", Authorization=f"Bearer {TOKEN}")[0] == 200
        assert server.request("GET", "/metrics", Cookie=f"{server.cookie}={server.sign_in(TOKEN)}")[0] == 200


def test_right_token_is_accepted_at_once_while_wrong_ones_are_slowed_down(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wrong_tokens, "DELAYS_S", (10 * TIMEOUT_S,))
    monkeypatch.setattr(wrong_tokens, "MAX_WAITING", 4)
    right, wrong = {"Authorization": f"Bearer {TOKEN}"}, {"Authorization": "Bearer wrong"}
    with pages(segment, SECRETS, roles=()) as server, ExitStack() as stack:
        for _ in range(wrong_tokens.FREE):
            assert server.request("GET", "/metrics", **wrong)[0] == 401
        slowed = []
        for path in ("/metrics", "/session") * 3:  # the answers to the first two make room for the last two
            client = http.client.HTTPConnection("127.0.0.1", server.port, timeout=TIMEOUT_S)
            stack.callback(client.close)
            if path == "/metrics":
                client.request("GET", path, headers=wrong)
            else:
                client.request("POST", path, json.dumps({"token": "wrong"}))
            slowed.append(client)
            while server.waiting() < min(len(slowed), 4):
                pass
        assert [slowed[n].getresponse().status for n in range(2)] == [401, 403]
        assert server.waiting() == 4
        assert server.request("GET", "/metrics", **right)[0] == 200
        assert server.sign_in(TOKEN)
        assert server.waiting() == 4


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("{", "malformed"),
        ('{"id": 7, "call": "nothing"}', "unknown call 'nothing'"),
        ('{"id": 7, "call": "overview.follow", "with": {"x": 1}}', "malformed"),
        (f'{{"id": 7, "call": {"[" * 5000}', "malformed"),
    ],
)
def test_wrong_call_is_answered(segment: Segment, text: str, error: str) -> None:
    with pages(segment) as server, server.open() as browser:
        browser.send(text)
        assert error in json.loads(browser.recv(TIMEOUT_S))["error"]
        assert said(browser, "overview.follow")["result"] is None


def test_role_is_needed(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    call = page.Call("control", page.Nothing, TABS[0].calls["overview.follow"].function)
    monkeypatch.setattr(TABS[0], "calls", {"overview.follow": call})
    with pages(segment) as server, server.open() as browser:
        assert "needs the role control" in said(browser, "overview.follow")["error"]


def test_client_with_many_calls_under_way_delays_only_itself(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    async def wait(*_: object) -> None:
        await asyncio.Event().wait()

    called = {
        name: page.Call(role, page.Nothing, wait)
        for name, role in (("overview.wait", "read"), ("overview.do", "write"))
    }
    monkeypatch.setattr(TABS[0], "calls", {**TABS[0].calls, **called})
    tokens = (*SECRETS, Secret("bob", frozenset({"read"}), digest(b"bobs")))
    with pages(segment, tokens, roles=()) as server, ExitStack() as stack:
        for _ in range(3):
            busy = stack.enter_context(server.open(server.sign_in(TOKEN)))
            for number in range(page.MAX_CALLS):
                busy.send(json.dumps({"id": number, "call": "overview.wait"}))
        with server.open(server.sign_in("bobs")) as other:
            assert said(other, "registers.rows", first=0, count=0)["result"]["rows"] == []
        with server.open(server.sign_in(TOKEN)) as same:  # calls with other roles, and of tabs with limits of their own
            assert "needs the role write" in said(same, "overview.do")["error"]
            assert said(same, "recordings.files")["result"]["files"] == []


def test_client_with_most_pages_makes_room_for_others(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app, "MAX_PAGES", 3)
    tokens = (*SECRETS, Secret("bob", frozenset({"read"}), digest(b"bobs")))
    with pages(segment, tokens, roles=()) as server, ExitStack() as stack:
        cookie = server.sign_in(TOKEN)
        many = [stack.enter_context(server.open(cookie)) for _ in range(3)]
        for one in many:
            assert said(one, "overview.follow")["result"] is None
        with server.open(server.sign_in("bobs")) as other:
            assert said(other, "overview.follow")["result"] is None
            with pytest.raises(ConnectionClosed, match="another client needs one"):
                said(many[0], "overview.leave")
            with server.open(cookie) as further, pytest.raises(ConnectionClosed, match="3 pages are open"):
                said(further, "overview.follow")
            assert said(many[1], "overview.follow")["result"] is None
            assert said(other, "overview.follow")["result"] is None


BY_GRPC = {
    "registers.set": "Write",
    "registers.override": "Inject",
    "registers.lift": "Lift",
    "injections.start": "Declare",
    "injections.lift": "Lift",
    "injections.lift_all": "LiftAll",
    "time.step": "Step",
    "time.play": "Play",
    "time.pause": "Pause",
    "time.release": "Release",
    "recordings.replay": "Replay",
}
"""The calls of a page that change something, and the calls of gRPC that do the same."""
ONLY_HERE = {"overview.restart": "control", "configuration.reload": "control"}


def test_calls_need_the_roles_of_grpc() -> None:
    needed = {name: call.role for tab in TABS for name, call in tab.calls.items()}
    changing = {name: role for name, role in needed.items() if role != "read"}
    assert changing == {name: NEEDS[f"/shmio.v1.Shmio/{call}"] for name, call in BY_GRPC.items()} | ONLY_HERE
    reading = {name.partition(".")[2] for name, role in needed.items() if role == "read"}
    assert reading == {
        "check", "condition", "describe", "files", "follow", "get", "leave", "lines", "more", "past", "plot",
        "registers", "replays", "rows", "state", "stop", "verify",
    }  # fmt: skip


def test_large_message_ends_only_its_own_page(segment: Segment) -> None:
    with pages(segment) as server, server.open() as other:
        with server.open() as browser:
            browser.send("x" * (MAX_MESSAGE_BYTES + 1))
            with pytest.raises(ConnectionClosed):
                browser.recv(TIMEOUT_S)
        assert said(other, "overview.follow")["result"] is None


def test_number_of_pages_is_bounded_and_silent_ones_are_closed(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "MAX_PAGES", 1)
    monkeypatch.setattr(page, "FIRST_CALL_S", 0.2)
    with pages(segment) as server:
        with server.open() as silent, pytest.raises(ConnectionClosed, match="no call in time"):
            silent.recv(TIMEOUT_S)
        with server.open() as browser:
            assert said(browser, "overview.follow")["result"] is None
            with server.open() as second, pytest.raises(ConnectionClosed, match="1 pages are open"):
                said(second, "overview.follow")
            assert said(browser, "overview.follow")["result"] is None


def test_silent_sockets_keep_nobody_out(segment: Segment) -> None:
    with pages(segment) as server, server.open() as present, ExitStack() as stack:
        assert said(present, "registers.rows", first=0, count=0)["result"]["rows"] == []
        for _ in range(700):
            silent = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=TIMEOUT_S))
            silent.sendall(UPGRADE)
        with server.open() as browser:
            assert said(browser, "registers.rows", first=0, count=0)["result"]["rows"] == []
        assert said(present, "registers.rows", first=0, count=0)["result"]["rows"] == []
