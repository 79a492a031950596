"""Servers that do not speak rosbridge, or speak it to do harm.

The connector fails in time, uses little memory, and never shows a wrong value.
"""

from __future__ import annotations

import base64
import hashlib
import socket
import threading
import time
import tracemalloc
from contextlib import closing

import pytest

from shmio.connectors.ros.rosbridge import RosbridgeConnector, RosbridgeOptions
from shmio.errors import ConnectorError
from shmio.model.statuses import GOOD, StatusArea
from tests.unit.connectors import hostile
from tests.unit.connectors.source import layout_of

TIMEOUT_MS = 400
NEVER = threading.Event()
LAYOUT = layout_of({"x": ("LREAL", "/t std_msgs/Float64 data")})
_KEY = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"


def upgraded(then: hostile.Behaviour) -> hostile.Behaviour:
    """Open a WebSocket as a server does, and then do what ``then`` does."""

    def behave(client: socket.socket) -> None:
        request = b""
        while b"\r\n\r\n" not in request:
            request += client.recv(4096)
        key = next(line for line in request.split(b"\r\n") if line.lower().startswith(b"sec-websocket-key"))
        digest = hashlib.sha1(key.partition(b":")[2].strip() + _KEY).digest()
        client.sendall(
            b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: "
            + base64.b64encode(digest) + b"\r\n\r\n"
        )  # fmt: skip
        then(client)

    return behave


def alive(fragments: bytes) -> hostile.Behaviour:
    """Begin a message, send the same fragments again and again, and answer each ping."""

    def behave(client: socket.socket) -> None:
        waiting = bytearray()
        client.sendall(TEXT + b"\0")
        while True:
            client.sendall(fragments)
            waiting += client.recv(4096)
            while len(waiting) > 8:
                extended = 2 if waiting[1] & 0x7F == 126 else 0
                size = int.from_bytes(waiting[2:4], "big") if extended else waiting[1] & 0x7F
                start = 2 + extended + 4
                if len(waiting) < start + size:
                    break
                payload = bytes(
                    one ^ waiting[start - 4 + at % 4] for at, one in enumerate(waiting[start : start + size])
                )
                if waiting[0] == PING[0]:
                    client.sendall(b"\x8a" + bytes([size]) + payload)
                del waiting[: start + size]

    return behave


TEXT, FRAGMENT, PING = b"\x01", b"\x00", b"\x89"
LONG = b"\x7e\xff\xff" + b"a" * 65535
BEFORE = {
    "silence": hostile.silence,
    "closes at once": hostile.closes,
    "HTTP": hostile.sends(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n"),
    "zeros": hostile.sends(bytes(4096)),
    "a status line without end": hostile.endless(b"a" * 65536, b"HTTP/1.1 101 "),
    "headers without end": hostile.endless(b"X: y\r\n" * 1000, b"HTTP/1.1 101 OK\r\n"),
    "a trickle": hostile.trickle(b"HTTP/1.1 101 Switching Protocols\r\n"),
    "another key": hostile.sends(
        b"HTTP/1.1 101 OK\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: x\r\n\r\n"
    ),
}
AFTER = {
    "silence": hostile.silence,
    "zeros": hostile.sends(bytes(4096)),
    "a masked frame": hostile.sends(b"\x81\x82abcd{}"),
    "a reserved kind": hostile.sends(b"\x83\x00"),
    "a frame of 2^63 bytes": hostile.endless(bytes(65536), b"\x81\x7f\x7f" + b"\xff" * 7),
    "fragments without end": hostile.endless(FRAGMENT + LONG, TEXT + LONG),
    "empty fragments without end": hostile.endless((FRAGMENT + b"\0") * 30_000, TEXT + b"\0"),
    "empty fragments without end, but alive": alive((FRAGMENT + b"\0") * 3000),
    "a long ping": hostile.sends(PING + LONG),
    "a trickle of a message": hostile.trickle(b"\x81\x7e\xff\xff" + b"a" * 1000),
    "text that is no UTF-8": hostile.sends(b"\x81\x02\xff\xff"),
}


@pytest.mark.parametrize(
    "behave",
    [*BEFORE.values(), *map(upgraded, AFTER.values())],
    ids=[*(f"before: {name}" for name in BEFORE), *(f"after: {name}" for name in AFTER)],
)
def test_a_hostile_server_is_refused_in_time_and_costs_little(behave: hostile.Behaviour) -> None:
    with hostile.peer(behave) as address:
        options = RosbridgeOptions(url=f"ws://{address}", timeout=TIMEOUT_MS)
        with closing(RosbridgeConnector(options, LAYOUT)) as connector:
            tracemalloc.start()
            try:
                begun = time.monotonic()
                with pytest.raises(ConnectorError) as raised:
                    read_on(connector)
                assert time.monotonic() - begun < connector.timeout_s + 5
                assert f"{address}" in str(raised.value)
                assert tracemalloc.get_traced_memory()[1] < 32 << 20
            finally:
                tracemalloc.stop()


def read_on(connector: RosbridgeConnector) -> None:
    """Read until the connector raises an error. Fail if it shows a value as good."""
    connector.connect()
    area = StatusArea(LAYOUT)
    while area.get(connector.read(), 0).code != GOOD:
        NEVER.wait(0.002)
    pytest.fail("a value is shown as good")
