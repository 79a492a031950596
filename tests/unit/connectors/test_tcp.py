"""The time-out of a host name with several addresses."""

from __future__ import annotations

import socket
import threading
from typing import Any

import pytest

from shmio.connectors import tcp


def test_a_silent_address_leaves_time_for_the_next_one() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as silent, socket.create_server(("127.0.0.1", 0)) as good:
        full = [socket.socket() for _ in range(4)]  # a full backlog: the next connection is not answered
        for one in full:
            one.setblocking(False)
            one.connect_ex(silent.getsockname())
        places: list[Any] = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", one.getsockname()) for one in (silent, good)]
        with tcp.connect(places, 1.0) as opened:
            assert opened.getpeername() == good.getsockname()
        for one in full:
            one.close()


def test_the_error_of_the_last_address_is_raised() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        place = server.getsockname()
    places: list[Any] = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", place)] * 2
    with pytest.raises(ConnectionRefusedError):
        tcp.connect(places, 1.0)


def test_a_name_server_that_does_not_answer_costs_no_more_than_the_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    real, answered = socket.getaddrinfo, threading.Event()

    def silent(host: str, port: int, flags: int = 0, **named: Any) -> Any:
        if not flags:
            answered.wait()
        return real(host, port, flags=flags, **named)

    monkeypatch.setattr(socket, "getaddrinfo", silent)
    assert tcp.look_up("127.0.0.1", 102, 0.01)[0][4] == ("127.0.0.1", 102)
    try:
        with pytest.raises(socket.gaierror, match="no name server has answered"):
            tcp.look_up("plc.example", 102, 0.01)
    finally:
        answered.set()
    assert tcp.look_up("localhost", 102, 10.0)
