"""The time-out of a host name with several addresses."""

from __future__ import annotations

import socket
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
