"""The control socket: requests, refusals, and clients that do not read or write."""

from __future__ import annotations

import json
import os
import resource
import selectors
import socket
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec
import pytest

from shmio import control
from shmio.control import Answer, ControlServer, Peer, Request, Restart, Stop, Where
from shmio.errors import ControlError


class Served:
    """A control server. The test's thread runs it step by step."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.selector = selectors.DefaultSelector()
        self.requests: list[tuple[Request, Answer]] = []
        self.server = ControlServer(
            path, self.selector, lambda request, answer: self.requests.append((request, answer))
        )

    def turn(self) -> None:
        """Handle the pending events without waiting."""
        while events := self.selector.select(0):
            for key, _ in events:
                key.data()

    def client(self, data: bytes = b"") -> socket.socket:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.settimeout(10)
        client.connect(self.path)
        client.sendall(data)
        self.turn()
        return client

    def close(self) -> None:
        self.server.close()
        self.selector.close()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    served = Served(str(tmp_path / "a.sock"))
    yield served
    served.close()


def answer_to(client: socket.socket) -> dict[str, object]:
    received = b""
    with client:
        while data := client.recv(4096):
            received += data
    found = json.loads(received)
    assert isinstance(found, dict)
    return found


@pytest.mark.parametrize("request_", [Stop(), Restart("cell"), Where()])
def test_a_request_arrives_as_it_was_sent(served: Served, request_: Request) -> None:
    client = served.client(msgspec.json.encode(request_) + b"\n")
    [(request, answer)] = served.requests
    assert request == request_
    answer.ok(more=1)
    assert answer_to(client) == {"ok": True, "more": 1}


LONG = "x" * 1500


@pytest.mark.parametrize(
    ("sizes", "whole"),
    [
        ({"warnings": 10, "done": 10, "problems": 10}, ["warnings", "done", "problems"]),
        ({"warnings": 500, "done": 10, "problems": 10}, ["done", "problems"]),
        ({"warnings": 20, "done": 40, "problems": 10}, ["problems"]),
        ({"warnings": 0, "done": 200, "problems": 200}, []),
    ],
)
def test_a_long_answer_drops_its_least_urgent_lines_first(
    served: Served, sizes: dict[str, int], whole: list[str]
) -> None:
    client = served.client(b'{"do": "reload"}\n')
    kept = [f"{number:040}" for number in range(200)]
    served.requests[0][1].ok(**{key: [LONG] * size for key, size in sizes.items()}, kept=kept)
    received = b""
    with client:
        while data := client.recv(4096):
            received += data
    assert len(received) <= control.MAX_ANSWER_BYTES
    answer = json.loads(received)
    assert answer["kept"] == kept
    for key, size in sizes.items():
        told = answer[key]
        if key in whole or not size:
            assert told == [LONG] * size
        else:
            assert told[-1].startswith(f"… and {size - len(told) + 1} more")
    if not whole:
        assert len(answer["done"]) == 1
        assert len(received) > control.MAX_ANSWER_BYTES - 2 * len(LONG), "the answer is filled up to its limit"


def test_a_long_error_is_cut(served: Served) -> None:
    client = served.client(b'{"do": "reload"}\n')
    served.requests[0][1].error("é" * 100_000)
    assert answer_to(client) == {"error": "é" * 1999 + "…"}


def test_retiring_leaves_a_successors_socket_alone(served: Served) -> None:
    successor = Served(served.path)
    served.server.retire()
    client = successor.client(b'{"do": "where"}\n')
    assert [request for request, _ in successor.requests] == [Where()]
    client.close()
    successor.close()


def test_a_client_stops_waiting_when_its_check_finds_a_reason(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as silent:
        silent.bind(str(tmp_path / "s"))
        silent.listen()
        with pytest.raises(ControlError, match="it is asleep"):
            control.request(str(tmp_path / "s"), Where(), 3600, lambda: "it is asleep")


def test_a_client_waits_until_the_backlog_has_room(tmp_path: Path) -> None:
    """When a UNIX socket's backlog is full, connect fails at once."""
    path = str(tmp_path / "s")
    with ExitStack() as stack:
        listener = stack.enter_context(socket.socket(socket.AF_UNIX))
        listener.bind(path)
        listener.listen(0)
        first = stack.enter_context(socket.socket(socket.AF_UNIX))
        first.connect(path)
        with pytest.raises(ControlError, match="has not answered within 0 s"):
            control.request(path, Where(), 0)
        with pytest.raises(ControlError, match="it is asleep"):
            control.request(path, Where(), 3600, lambda: "it is asleep")

        def make_room() -> None:  # after the client has found the backlog full
            stack.enter_context(listener.accept()[0])
            with listener.accept()[0] as client:
                client.recv(4096)
                client.sendall(b'{"ok": true}\n')

        thread = threading.Thread(target=make_room)
        answer = control.request(path, Where(), 3600, lambda: None if thread.is_alive() else thread.start())
        thread.join()
    assert answer == {"ok": True}


def test_a_request_may_arrive_in_pieces(served: Served) -> None:
    client = served.client(b'{"do": ')
    assert served.requests == []
    client.sendall(b'"stop"}\n')
    served.turn()
    assert served.requests[0][0] == Stop()
    served.requests[0][1].error("no")
    assert answer_to(client) == {"error": "no"}


@pytest.mark.parametrize(
    "data",
    [
        b"\n",
        b"garbage\n",
        b"\xff\xfe\n",
        b"[" * 4000 + b"\n",
        b'{"do": "format the disk"}\n',
        b'{"do": "stop", "more": 1}\n',
        b'{"do": "restart"}\n',
        b'{"do": "restart", "name": 5}\n',
        b'{"do": "stop"}\n{"do": "stop"}\n',
        b"x" * (control.MAX_REQUEST_BYTES + 1),
        b'{"do": "stop"}' + b" " * control.MAX_REQUEST_BYTES + b"\n",
    ],
)
def test_invalid_requests_are_refused(served: Served, data: bytes) -> None:
    client = served.client(data)
    assert served.requests == []
    assert list(answer_to(client)) == ["error"]


def test_a_silent_client_is_dropped_after_the_time_out(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    client = served.client(b'{"do"')
    served.server.expire()
    other = served.client(b'{"do": "stop"}\n')
    assert served.requests, "the silent client does not delay others"
    moved = time.monotonic() + control.REQUEST_S + 1
    monkeypatch.setattr(time, "monotonic", lambda: moved)
    served.server.expire()
    assert "no request arrived within" in str(answer_to(client)["error"])
    served.requests[0][1].ok()
    assert answer_to(other) == {"ok": True}, "a client whose request is in progress is not dropped"


def test_too_many_clients_are_refused(served: Served) -> None:
    refused = {"error": "too many control connections at once"}
    silent = [served.client() for _ in range(control.MAX_CLIENTS)]
    clients = [served.client(b'{"do": "where"}\n') for _ in silent]
    assert [answer_to(client) for client in silent] == [refused] * len(silent), (
        "silent clients are dropped to make room"
    )
    assert len(served.requests) == control.MAX_CLIENTS
    assert answer_to(served.client()) == refused, "clients being served are not dropped"
    clients.pop().close()
    served.turn()
    clients.append(served.client(b'{"do": "where"}\n'))
    assert len(served.requests) == control.MAX_CLIENTS + 1
    for client in clients:
        client.close()


def test_the_request_of_a_client_that_has_left_is_dropped(served: Served) -> None:
    """The client's user was told that the request had no answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(served.path)
        client.sendall(b'{"do": "stop"}\n')
    served.turn()
    assert served.requests == []


def test_a_client_that_leaves_before_its_answer_does_no_harm(served: Served) -> None:
    served.client(b'{"do": "stop"}\n').close()
    served.turn()
    served.requests[0][1].ok()
    client = served.client(b'{"do": "stop"}\n')
    client.close()
    served.requests[1][1].ok()


def test_server_rests_while_no_descriptor_is_free(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as stack:
        resource.setrlimit(resource.RLIMIT_NOFILE, (300, hard))
        try:
            client = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            with suppress(OSError):
                while True:
                    stack.enter_context(Path(os.devnull).open())
            client.connect(served.path)
            client.sendall(b'{"do": "where"}\n')
            served.turn()  # ends: the waiting client causes no endless work
            assert caplog.messages == ["the control socket accepts nobody now: Too many open files"]
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        served.server.expire()
        served.turn()
        assert [request for request, _ in served.requests] == [Where()]


def test_other_users_are_refused(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    own = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: own + 1)
    client = served.client(b'{"do": "stop"}\n')
    trusted = own == 0  # root is allowed
    assert bool(served.requests) is trusted
    if not trusted:
        assert answer_to(client) == {"error": "only the supervisor's own user and root may control it"}
    client.close()


def test_the_socket_is_private_to_its_user_and_removed_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    served = Served(str(path))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    served.close()
    assert not path.exists()


def test_a_dead_supervisors_socket_is_replaced_but_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(path))
    Served(str(path)).close()
    path.write_text("precious")
    with pytest.raises(ControlError, match=str(path)):
        Served(str(path))
    assert path.read_text() == "precious"


def test_a_retired_server_still_answers(served: Served) -> None:
    client = served.client(b'{"do": "stop"}\n')
    served.server.retire()
    assert not Path(served.path).exists()
    served.requests[0][1].ok()
    assert answer_to(client) == {"ok": True}


def test_request_returns_the_answer_or_raises_its_error(served: Served) -> None:
    got: list[object] = []

    def ask() -> None:
        try:
            got.append(control.request(served.path, Restart("x"), 10))
        except ControlError as error:
            got.append(str(error))

    for outcome in ({"ok": True}, "no process x"):
        asking = threading.Thread(target=ask)
        asking.start()
        while not served.requests:
            for key, _ in served.selector.select(10):
                key.data()
        _, answer = served.requests.pop()
        answer.error(outcome) if isinstance(outcome, str) else answer.ok()
        asking.join()
        assert got.pop() == outcome


def test_request_fails_without_a_server_or_without_an_answer(tmp_path: Path) -> None:
    with pytest.raises(ControlError, match="cannot be reached"):
        control.request(str(tmp_path / "none.sock"), Stop(), 1)
    with pytest.raises(ControlError, match="cannot be reached: the instance names no control socket"):
        control.request("", Stop(), 1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as deaf:
        deaf.bind(str(tmp_path / "deaf.sock"))
        deaf.listen(1)
        with pytest.raises(ControlError, match=r"not answered within 0\.01 s"):
            control.request(str(tmp_path / "deaf.sock"), Stop(), 0.01)


@pytest.mark.parametrize(
    "answer",
    [b"", b"garbage\n", b"[]\n", b'{"ok": "\xff"}\n', b'{"a":' * 12_000 + b"\n", b"x" * (2 * control.MAX_ANSWER_BYTES)],
)
def test_hostile_answers_raise_a_control_error(tmp_path: Path, answer: bytes) -> None:
    """The command prints one line, and reads no more than the longest allowed answer."""
    path = tmp_path / "taken.sock"
    with socket.socket(socket.AF_UNIX) as hijacker:
        hijacker.bind(str(path))
        hijacker.listen()

        def reply() -> None:
            taken, _ = hijacker.accept()
            with taken, suppress(OSError):  # the client closed the connection
                taken.recv(control.MAX_REQUEST_BYTES)
                taken.sendall(answer)

        serving = threading.Thread(target=reply)
        serving.start()
        with pytest.raises(ControlError):
            control.request(str(path), Stop(), 60)
        serving.join()


def test_a_busy_program_makes_room_before_another_one(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the silent clients, one of the program that has most of them is dropped, not the one silent longest."""
    pids: dict[socket.socket, int] = {}
    monkeypatch.setattr(control, "_peer", lambda one: Peer(pids.setdefault(one, min(len(pids), 1)), os.getuid()))
    other, *busy = (served.client() for _ in range(control.MAX_CLIENTS + 1))
    assert answer_to(busy[0]) == {"error": "too many control connections at once"}
    other.sendall(b'{"do": "where"}\n')
    served.turn()
    assert len(served.requests) == 1
    for client in (other, *busy):
        client.close()


def test_all_clients_that_wait_are_accepted_at_once(served: Served) -> None:
    waiting = [socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(control.MAX_CLIENTS)]
    for client in waiting:
        client.connect(served.path)
    ((accept, _),) = served.selector.select(0)
    accept.data()
    assert served.selector.select(0) == []
    for client in waiting:
        client.close()
