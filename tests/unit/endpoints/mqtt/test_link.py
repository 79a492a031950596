"""The connection to the broker, by itself."""

from __future__ import annotations

import selectors
import socket
import threading
from typing import Any

import pytest

from shmio.config import Mqtt
from shmio.endpoints.mqtt.channel import Message
from shmio.endpoints.mqtt.link import Link
from shmio.endpoints.mqtt.target import Dialling

TIMEOUT_S = 30


def test_a_connection_that_comes_about_after_the_end_is_closed_and_wakes_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A name server may take longer than the bridge lives."""
    asked, answered, woken = threading.Event(), threading.Event(), threading.Event()
    look_up = socket.getaddrinfo

    def slowly(*arguments: Any, **named: Any) -> Any:
        asked.set()
        assert answered.wait(TIMEOUT_S)
        return look_up(*arguments, **named)

    monkeypatch.setattr("socket.getaddrinfo", slowly)
    with socket.create_server(("127.0.0.1", 0)) as server, selectors.DefaultSelector() as selector:
        server.settimeout(TIMEOUT_S)
        settings = Mqtt(broker="external", host=f"127.0.0.1:{server.getsockname()[1]}")
        link = Link(Dialling(settings, "test", str), selector, woken.set, lambda: Message("will", b"", 1, retain=True))
        link.turn()
        assert asked.wait(TIMEOUT_S)
        link.close()
        answered.set()
        connection, _ = server.accept()
        with connection:
            connection.settimeout(TIMEOUT_S)
            while connection.recv(1000):
                pass
        assert not woken.is_set()
