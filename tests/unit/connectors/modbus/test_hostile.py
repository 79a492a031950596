"""Devices that do not speak Modbus, or do so to do harm: in time, with little memory, and without a wrong value."""

from __future__ import annotations

import socket
import threading
import time
import tracemalloc
from collections.abc import Callable
from contextlib import closing

import pytest

from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.connectors.modbus.plan import RETRY_NS
from shmio.errors import ConnectorError
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.model.statuses import BAD_OUT_OF_RANGE, GOOD, StatusArea
from tests.unit.connectors import hostile

TIMEOUT_MS = 300
LAYOUT = place_tags(
    "plant", {f"r{number}": {"type": "INT", "address": f"holding {2 * number}"} for number in range(50)}
).with_statuses()
RIGHT = b"\0\x01\0\0\0\xc9\x01\x03\xc6"
"""The beginning of the right answer to the first request, with 99 words."""


def source(port: int, layout: Layout = LAYOUT) -> ModbusConnector:
    return ModbusConnector(ModbusOptions(host="127.0.0.1", port=port, timeout=TIMEOUT_MS), layout)


def read_once(connector: ModbusConnector) -> None:
    connector.connect()
    connector.read()


HOSTILE = {
    "silence": hostile.silence,
    "closes at once": hostile.closes,
    "HTTP": hostile.sends(b"HTTP/1.1 400 Bad Request\r\n\r\n"),
    "zeros": hostile.sends(bytes(4096)),
    "ones": hostile.sends(b"\xff" * 4096),
    "zeros without end": hostile.endless(bytes(1 << 16)),
    "a huge length": hostile.endless(bytes(1 << 16), b"\0\x01\0\0\xff\xff\x01\x03\xff"),
    "no length": hostile.sends(b"\0\x01\0\0\0\0\x01\x03"),
    "another unit": hostile.sends(b"\0\x01\0\0\0\xc9\x02\x03\xc6" + bytes(198)),
    "another function": hostile.sends(b"\0\x01\0\0\0\xc9\x01\x04\xc6" + bytes(198)),
    "another protocol": hostile.sends(b"\0\x01\0\x01\0\xc9\x01\x03\xc6" + bytes(198)),
    "fewer words": hostile.sends(b"\0\x01\0\0\0\x05\x01\x03\x02\0\0"),
    "a wrong count of bytes": hostile.sends(b"\0\x01\0\0\0\xc9\x01\x03\xc5" + bytes(198)),
    "a half answer": hostile.sends(RIGHT + bytes(100)),
    "the right answer in a trickle": hostile.trickle(RIGHT + bytes(198)),
}


@pytest.mark.parametrize("behave", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_device_is_refused_in_time_and_costs_little(behave: hostile.Behaviour) -> None:
    with hostile.peer(behave) as address, closing(source(address.port)) as connector:
        tracemalloc.start()
        try:
            begun = time.monotonic()
            with pytest.raises(ConnectorError) as raised:
                read_once(connector)
            assert time.monotonic() - begun < 2 * TIMEOUT_MS / 1000 + 5
            assert f"127.0.0.1:{address.port}" in str(raised.value)
            assert tracemalloc.get_traced_memory()[1] < 4 << 20
        finally:
            tracemalloc.stop()


def answering(answer: Callable[[bytes, int], bytes]) -> hostile.Behaviour:
    """Answer each request by what a function makes of it and of its number."""

    def behave(client: socket.socket) -> None:
        number = 0
        while request := client.recv(300):
            number += 1
            client.sendall(answer(request, number))

    return behave


def right(request: bytes, value: int) -> bytes:
    """Return the right answer to a read of words, all with this value."""
    words = int.from_bytes(request[10:12], "big")
    data = bytes((request[6], 3, 2 * words)) + value.to_bytes(2, "big") * words
    return request[:4] + len(data).to_bytes(2, "big") + data


def values(image: bytes) -> set[object]:
    return {codec(register, LAYOUT.byte_order).decode(image) for register in LAYOUT.registers}


def test_an_answer_that_comes_twice_is_no_answer_to_the_next_request() -> None:
    twice = answering(lambda request, number: 2 * right(request, number))
    with hostile.peer(twice) as address, closing(source(address.port)) as connector:
        for _ in range(3):
            connector.connect()
            assert values(connector.read()) == {1}
            with pytest.raises(ConnectorError, match="a request that is not in flight"):
                connector.read()


def test_a_device_that_refuses_everything_gives_no_value() -> None:
    refusing = answering(lambda request, _: request[:4] + b"\0\x03" + request[6:7] + b"\x83\x02")
    with hostile.peer(refusing) as address, closing(source(address.port)) as connector:
        connector.connect()
        image = connector.read()
        area = StatusArea(LAYOUT)
        found = {area.get(image, index).code for index in range(len(LAYOUT.registers))}
        assert found == {BAD_OUT_OF_RANGE}


def test_a_device_that_refuses_slowly_is_searched_for_half_a_time_out() -> None:
    """Its connection is not lost, and the next cycles continue the search."""

    def refuse(request: bytes, _: int) -> bytes:
        threading.Event().wait(0.02)
        return request[:4] + b"\0\x03" + request[6:7] + b"\x83\x02"

    with hostile.peer(answering(refuse)) as address, closing(source(address.port)) as connector:
        connector.connect()
        for _ in range(3):
            image = connector.read()
            area = StatusArea(LAYOUT)
            assert {area.get(image, index).code for index in range(len(LAYOUT.registers))} == {BAD_OUT_OF_RANGE}


@pytest.mark.parametrize("code", [2, 4, 8])
def test_an_address_that_recovers_is_read_with_the_others_again(code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [10**12]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    refused, sent = {2}, []

    def answer(request: bytes, _: int) -> bytes:
        start, count = int.from_bytes(request[8:10], "big"), int.from_bytes(request[10:12], "big")
        sent.append((start, count))
        if refused.intersection(range(start, start + count)):
            return request[:4] + b"\0\x03" + request[6:7] + bytes((request[7] | 0x80, code))
        return request[:4] + (3 + 2 * count).to_bytes(2, "big") + request[6:8] + bytes((2 * count,)) + bytes(2 * count)

    area = StatusArea(LAYOUT)
    with hostile.peer(answering(answer)) as address, closing(source(address.port)) as connector:
        connector.connect()

        def bad() -> list[int]:
            image = connector.read()
            return [index for index in range(len(LAYOUT.registers)) if area.get(image, index).code != GOOD]

        assert bad() == [1]
        sent.clear()
        assert bad() == [1]
        assert all(2 not in range(start, start + count) for start, count in sent)
        refused.clear()
        now_ns[0] += RETRY_NS
        assert bad() == [1]
        sent.clear()
        assert bad() == []
        assert len(sent) == 1
