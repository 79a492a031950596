"""The client against a peer that answers with damaged or foreign bytes."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.modbus.client import ModbusClient, RefusedError
from shmio.errors import ConnectorError
from shmio.layout.addresses.modbus import Table

PATIENCE_S = 20.0


class Peer:
    """Accepts one connection after the other, and answers the first request of each with given bytes, then closes."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.answer = b""
        """The answer; its first two bytes are replaced by the transaction of the request if they are TT."""
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection:
                request = connection.recv(300)
                answer = self.answer
                if answer[:2] == b"TT":
                    answer = request[:2] + answer[2:]
                connection.sendall(answer)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(PATIENCE_S)


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.close()


RIGHT = b"TT\0\0\0\x07\x01\x03\x04\x11\x22\x33\x44"
"""The answer to a read of two holding registers of unit 1."""


def read(peer: Peer, answer: bytes) -> bytes:
    peer.answer = answer
    client = ModbusClient("127.0.0.1", peer.port, 20_000)
    try:
        client.connect()
        client.begin()
        return client.read(1, Table.HOLDING, 0, 2)
    finally:
        client.close()


def test_the_right_answer_is_read(peer: Peer) -> None:
    assert read(peer, RIGHT) == b"\x11\x22\x33\x44"


def test_an_exception_is_named(peer: Peer) -> None:
    with pytest.raises(RefusedError, match="illegal data address") as error:
        read(peer, b"TT\0\0\0\x03\x01\x83\x02")
    assert error.value.code == 2


@given(st.data())
def test_no_damaged_answer_becomes_a_value(peer: Peer, data: st.DataObject) -> None:
    head = bytearray(RIGHT[:9])
    for _ in range(data.draw(st.integers(1, 3))):
        head[data.draw(st.integers(0, 8))] = data.draw(st.integers(0, 255))
    if bytes(head) == RIGHT[:9]:
        return
    with pytest.raises(ConnectorError):
        read(peer, bytes(head) + RIGHT[9:] + data.draw(st.binary(max_size=8)))


@given(st.binary(max_size=400))
def test_no_foreign_bytes_become_a_value(peer: Peer, answer: bytes) -> None:
    with pytest.raises(ConnectorError):
        read(peer, answer.replace(b"TT", b"tt"))


@given(st.integers(0, len(RIGHT) - 1))
def test_no_part_of_an_answer_becomes_a_value(peer: Peer, size: int) -> None:
    with pytest.raises(ConnectorError, match="closed the connection"):
        read(peer, RIGHT[:size])
