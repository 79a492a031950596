"""Clients that break their connections in every state: the server keeps no slot, task, connection or descriptor."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import resource
import socket
import struct
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.frames import Frame, Opcode

from shmio.endpoints import wrong_tokens
from shmio.endpoints.web import app, page, server, uploads
from shmio.endpoints.web.tabs import TABS
from shmio.segment import Quality, Segment
from shmio.testing.cell import until
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.web.harness import TIMEOUT_S
from tests.unit.endpoints.web.test_page import SECRETS, UPGRADE, Pages, pages, said

HOST = b" HTTP/1.1\r\nHost: localhost\r\n"
ALL_ROWS = {"first": 0, "count": 200, "expanded": ["cell", "cell/axis"]}


def post(path: bytes, body: bytes, missing: int = 0) -> bytes:
    return b"POST %b%bContent-Length: %d\r\n\r\n%b" % (path, HOST, len(body) + missing, body)


def sent(data: bytes, opcode: Opcode = Opcode.TEXT) -> bytes:
    return bytes(Frame(opcode, data).serialize(mask=True))


def call(name: str, **given: Any) -> bytes:
    return sent(json.dumps({"id": 1, "call": name, "with": given}).encode())


def calls(name: str, number: int, /, **given: Any) -> bytes:
    return UPGRADE + call(name, **given) * number


STATES = {
    "nothing is sent": b"",
    "half a request line": b"GET /met",
    "half the headers": b"GET /metrics" + HOST,
    "the page": b"GET /" + HOST + b"\r\n",
    "the figures": b"GET /metrics" + HOST + b"\r\n",
    "many figures, which nobody reads": (b"GET /metrics" + HOST + b"\r\n") * 100,
    "half a token": post(b"/session", b'{"token": "a', missing=9),
    "a wrong token": post(b"/session", b'{"token": "wrong"}'),
    "a wrong token of a scraper": b"GET /metrics" + HOST + b"Authorization: Bearer wrong\r\n\r\n",
    "half an upload": post(b"/layout", b'[{"name": "x.db", "size": 9}]\n', missing=9),
    "an upload that is being compiled": post(b"/layout", b'[{"name": "x.db", "size": 9}]\nDATA_BLOC'),
    "half a handshake": UPGRADE[:60],
    "a silent page": UPGRADE,
    "half a frame": UPGRADE + call("overview.follow")[:9],
    "half a message": UPGRADE + bytes([0x01, 0x80, 0, 0, 0, 0]),
    "a text that is not UTF-8": UPGRADE + sent(b"\xff\xfe"),
    "a frame that is none": UPGRADE + b"\xff\xff\xff\xff",
    "a page that follows the overview": calls("overview.follow", 1),
    "40 calls whose answers nobody reads": calls("registers.rows", 40, **ALL_ROWS),
    "40 calls that are under way": calls("overview.wait", 40),
    "a closing handshake during 40 calls": calls("overview.wait", 40) + sent(struct.pack(">H", 1000), Opcode.CLOSE),
    "a replay's calls": calls("recordings.replays", 20) + call("recordings.replay", sources=["cell"], paused=True),
    "pings": UPGRADE + sent(b"x" * 100, Opcode.PING) * 200,
}
ROUNDS = 44
"""Number of connections in each state, half of which are closed and half of which are reset: more than 1,000 in all."""


def reset(client: socket.socket) -> None:
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()


def sent_to(endpoint: Pages, request: bytes) -> socket.socket:
    """Return a connection on which a request was sent; what follows a handshake, after its answer."""
    client = socket.socket()
    client.settimeout(TIMEOUT_S)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.connect(("127.0.0.1", endpoint.port))
    if request.startswith(UPGRADE):
        client.sendall(UPGRADE)
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            answer += client.recv(1)
        assert answer.startswith(b"HTTP/1.1 101")
        request = request[len(UPGRADE) :]
    client.sendall(request)
    return client


@pytest.fixture(autouse=True)
def endless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add a call that never ends, and uploads that are never compiled."""

    async def wait(*_: object) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(TABS[0], "calls", {**TABS[0].calls, "overview.wait": page.Call("read", page.Nothing, wait)})
    monkeypatch.setattr(uploads, "compile_uploads", wait)


def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """Check that no line of the log has a traceback."""
    assert [record.getMessage() for record in caplog.records if record.exc_info] == []


def serves(endpoint: Pages) -> None:
    with endpoint.open() as browser:
        assert said(browser, "registers.rows", **ALL_ROWS)["result"]["total"] > 1


def test_nothing_outlives_a_connection(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(server, "REQUEST_S", 2 * TIMEOUT_S)
    monkeypatch.setattr(page, "FIRST_CALL_S", 2 * TIMEOUT_S)
    monkeypatch.setattr(wrong_tokens, "DELAYS_S", (0.1,))
    segment.writer("cell").publish(image(), cycle=1, quality=Quality.GOOD)
    with pages(segment, SECRETS) as endpoint:
        serves(endpoint)
        endpoint.request("GET", "/metrics")
        until(lambda: endpoint.held()["connections"] == 0, "the end of the first connections", TIMEOUT_S)
        before = endpoint.held()
        for number in range(ROUNDS):
            for request in STATES.values():
                client = sent_to(endpoint, request)
                (reset if number % 2 else socket.socket.close)(client)
        endpoint.request("GET", "/style.css")  # the server has seen all connections that came before this one
        until(lambda: endpoint.held() == before, f"what the server holds is {before} again", TIMEOUT_S)
        serves(endpoint)
    quiet(caplog)


def test_clients_that_neither_read_nor_leave_keep_no_slot(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Their connections stay open, as those of a host that has lost its power, or of one that wants to harm."""
    for place, name in (
        (server, "REQUEST_S"), (server, "UNREAD_S"), (server, "PING_S"), (page, "FIRST_CALL_S"), (page, "CLOSE_S"),
    ):  # fmt: skip
        monkeypatch.setattr(place, name, 0.3)
    segment.writer("cell").publish(image(), cycle=1, quality=Quality.GOOD)
    complete = {"the page", "the figures", "a wrong token", "a wrong token of a scraper"}
    ends = STATES.keys() - {"an upload that is being compiled"}  # the time limit of its process ends it
    with pages(segment) as endpoint, ExitStack() as stack:
        serves(endpoint)
        endpoint.request("GET", "/metrics")
        until(lambda: endpoint.held()["connections"] == 0, "the end of the first connections", TIMEOUT_S)
        before = endpoint.held()
        for number in range(app.MAX_PAGES + 10):
            for state in ends if number < 3 else ("40 calls whose answers nobody reads",):
                stack.enter_context(sent_to(endpoint, STATES[state]))

        def freed() -> bool:
            held = endpoint.held()
            rest = {"connections": 3 * len(complete), "descriptors": held["descriptors"]}  # they may send more requests
            return held | rest == before | rest and held["connections"] <= rest["connections"]

        until(freed, f"slots and tasks are {before} again", TIMEOUT_S)
        serves(endpoint)
    quiet(caplog)


def test_endpoint_recovers_when_no_descriptor_was_free(
    segment: Segment, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with pages(segment, folders={"logs": str(tmp_path)}) as endpoint, endpoint.open() as browser, ExitStack() as stack:
        assert said(browser, "registers.rows", **ALL_ROWS)["result"]["total"] > 1
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        clients = [stack.enter_context(socket.socket()) for _ in range(8)]
        resource.setrlimit(resource.RLIMIT_NOFILE, (300, hard))
        try:
            with suppress(OSError):
                while True:
                    stack.enter_context(Path(os.devnull).open())
            for client in clients:
                client.connect(("127.0.0.1", endpoint.port))
            until(
                lambda: any("out of system resource" in line for line in caplog.messages),
                "a line in the log",
                TIMEOUT_S,
            )
            assert said(browser, "log.lines", filter="", process="", count=1).keys() <= {"id", "result", "error"}
            assert said(browser, "registers.rows", **ALL_ROWS)["result"]["total"] > 1
        finally:
            stack.close()
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        serves(endpoint)
    quiet(caplog)
    assert any(record.name == "asyncio" and record.levelno == logging.ERROR for record in caplog.records)
