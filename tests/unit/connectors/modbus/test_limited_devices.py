"""Devices that close connections, know only some functions, or answer in frames of RTU."""

from __future__ import annotations

import logging
import socket
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest

from shmio.config import Address
from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.modbus.client import crc
from shmio.connectors.modbus.connector import ModbusConnector, ModbusOptions
from shmio.errors import ConnectorError
from shmio.layout.addresses.modbus import Table
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import encode
from tests.unit.connectors import hostile

TIMEOUT_MS = 20_000
TAGS: dict[str, object] = {
    "first": {"type": "UINT", "address": "holding 0"},
    "far": {"type": "REAL", "address": "holding 100"},
    "byte": {"type": "BYTE", "address": "holding 7"},
    "text": {"type": "STRING[5]", "address": "holding 4"},
    "coil": {"type": "BOOL", "address": "coil 3"},
    "coils": {"type": "ARRAY[0..9] OF BOOL", "address": "coil 10"},
}
LAYOUT = place_tags("plant", TAGS).with_statuses()
VALUES = {"first": 0x1234, "far": -2.5, "byte": 0x42, "text": "abc", "coil": True, "coils": [True, False] * 5}


class Device:
    """A device written for these tests, after the specification of the protocol.

    Attributes:
        known: The functions that it knows.
        answers: The number of answers after which it closes a connection; 0: it closes none.
        deaf: The functions that it carries out, and then closes the connection without an answer.

    """

    def __init__(self, known: Collection[int] = (1, 3, 5, 6, 15, 16, 22)) -> None:
        self.words, self.coils = [0xABCD] * 200, [0, 1] * 50
        self.known, self.answers, self.deaf = set(known), 0, set[int]()
        self.asked: list[int] = []
        self.connections = 0

    def __call__(self, client: socket.socket) -> None:
        self.connections += 1
        count = 0
        while not self.answers or count < self.answers:
            head = client.recv(7, socket.MSG_WAITALL)
            if len(head) < 7:
                return
            request = client.recv(int.from_bytes(head[4:6], "big") - 1, socket.MSG_WAITALL)
            answer = self.answer(request)
            if request[0] in self.deaf:
                return
            client.sendall(head[:4] + (len(answer) + 1).to_bytes(2, "big") + head[6:] + answer)
            count += 1

    def answer(self, request: bytes) -> bytes:
        function, start, value = struct.unpack_from(">BHH", request)
        self.asked.append(function)
        if function not in self.known:
            return bytes((function | 0x80, 1))
        if function == 1:
            packed = sum(one << place for place, one in enumerate(self.coils[start : start + value]))
            data = packed.to_bytes(-(-value // 8), "little")
            return bytes((function, len(data))) + data
        if function == 3:
            return bytes((function, 2 * value)) + struct.pack(f">{value}H", *self.words[start : start + value])
        if function == 5:
            self.coils[start] = value >> 8 & 1
        elif function == 6:
            self.words[start] = value
        elif function == 15:
            for place in range(value):
                self.coils[start + place] = request[6 + place // 8] >> place % 8 & 1
        elif function == 16:
            self.words[start : start + value] = struct.unpack_from(f">{value}H", request, 6)
        else:
            self.words[start] = self.words[start] & value | int.from_bytes(request[5:7], "big") & ~value
            return request
        return request[:5]


@contextmanager
def connected(behave: hostile.Behaviour, **options: Any) -> Iterator[ModbusConnector]:
    with hostile.peer(behave) as address, closing(source(address, **options)) as connector:
        connector.connect()
        yield connector


def source(address: Address, **options: Any) -> ModbusConnector:
    given: dict[str, Any] = {"host": address.host, "port": address.port, "timeout": TIMEOUT_MS} | options
    return ModbusConnector(ModbusOptions(**given), LAYOUT)


def values(connector: ModbusConnector) -> dict[str, object]:
    image = connector.read()
    return {one.path: codec(one, LAYOUT.byte_order).decode(image) for one in LAYOUT.registers}


def read_word(connector: ModbusConnector) -> bytes:
    connector._client.begin()
    return connector._client.read(1, Table.HOLDING, 0, 1)


def peek(connector: ModbusConnector) -> None:
    """Wait until the device has sent more, or has closed the connection."""
    opened = connector._client._socket
    assert opened is not None
    opened.settimeout(TIMEOUT_MS / 1000)
    opened.recv(1, socket.MSG_PEEK)


def write(connector: ModbusConnector, path: str, value: object) -> list[str]:
    return connector.write(encode(find(LAYOUT, path), value, LAYOUT.byte_order))


@pytest.mark.parametrize("answers", [1, 2, 3])
def test_a_device_that_closes_after_some_answers_is_read_and_written(answers: int) -> None:
    device = Device()
    device.answers = answers
    with connected(device) as connector:
        values(connector)
        for turn in range(3):
            for path, value in VALUES.items():
                if turn:  # before, a write may meet a connection that is just being closed
                    assert write(connector, path, value) == [""], path
            found = values(connector)
        assert found == VALUES
        assert device.connections > 3


def test_a_device_that_closes_while_nothing_is_asked_loses_neither_read_nor_write() -> None:
    """As one that closes after a second of silence, if the period is longer."""
    device = Device()
    device.answers = 1
    with connected(device) as connector:
        for turn in range(3):
            assert write(connector, "first", turn) == [""]
            peek(connector)  # wait until the device has closed the connection
            assert read_word(connector) == turn.to_bytes(2, "big")
            peek(connector)
        assert device.asked == [6, 3] * 3


def test_a_write_without_a_confirmation_is_never_repeated() -> None:
    device = Device()
    device.deaf = {6}
    with connected(device) as connector:
        with pytest.raises(WriteLostError, match="closed the connection") as lost:
            write(connector, "first", 5)
        assert lost.value.outcomes == (Lost.UNKNOWN,)
        assert device.asked.count(6) == 1


def test_a_read_is_repeated_once_and_not_more_often() -> None:
    device = Device()
    device.deaf = {1, 3}
    with connected(device) as connector:
        with pytest.raises(ConnectorError, match="closed the connection"):
            connector.read()
        assert len(device.asked) == 2


def test_a_read_before_a_write_that_is_lost_means_that_nothing_was_written() -> None:
    device = Device({1, 3, 5, 6, 15, 16})
    device.deaf = {3}
    with connected(device) as connector:
        with pytest.raises(WriteLostError) as lost:
            write(connector, "byte", 5)
        assert lost.value.outcomes == (Lost.UNSENT,)
        assert device.words[7] == 0xABCD


@pytest.mark.parametrize(
    "known", [{15, 16}, {5, 6}, {5, 16}, {6, 15}, {5, 6, 15, 16}, {5, 6, 22}, {15, 16, 22}], ids=str
)
def test_a_function_that_the_device_does_not_know_is_replaced_and_remembered(
    known: set[int], caplog: pytest.LogCaptureFixture
) -> None:
    device = Device({1, 3, *known})
    with connected(device) as connector, caplog.at_level(logging.WARNING, "shmio.source"):
        for _ in range(2):
            device.asked.clear()
            for path, value in VALUES.items():
                assert write(connector, path, value) == [""], path
        assert set(device.asked) <= {1, 3, *known}, "a function that the device refused is tried again"
        assert values(connector) == VALUES
        assert device.words[7] == 0xAB42
        assert device.words[4:7] == [0x6162, 0x6300, 0x00CD]  # the byte after the text is nobody's
        missing = {5, 6, 15, 16, 22} - known
        assert sorted(int(one.args[1]) for one in caplog.records) == sorted(missing)  # type: ignore[index, arg-type]


def test_a_write_that_no_function_carries_out_names_both() -> None:
    device = Device({1, 3})
    with connected(device) as connector:
        for path, named in (
            ("first", "6 and 16"),
            ("far", "16 and 6"),
            ("coil", "5 and 15"),
            ("byte", "22 and 6 and 16"),
        ):
            (refusal,) = write(connector, path, VALUES[path])
            assert refusal == f"the device refuses functions {named}: illegal function (exception 1)"
        device.known |= {6}
        assert write(connector, "first", 9) == [""]


def damaged(change: Callable[[bytes], bytes]) -> hostile.Behaviour:
    """Return a device whose answers are changed, header included."""
    device = Device()

    def behave(client: socket.socket) -> None:
        while request := client.recv(300):
            answer = device.answer(request[7:])
            client.sendall(change(request[:4] + (len(answer) + 1).to_bytes(2, "big") + request[6:7] + answer))

    return behave


def test_an_answer_to_another_request_is_named_with_both_numbers() -> None:
    for place, text in (
        (1, "it answered transaction 16, a request that is not in flight; transaction 1 is"),
        (6, "its answer does not belong to the request: unit 16 instead of 1"),
        (7, "its answer does not belong to the request: function 18 instead of 3"),
    ):
        behave = damaged(lambda one, at=place: one[:at] + bytes((one[at] ^ 0x11,)) + one[at + 1 :])  # type: ignore[misc]
        with connected(behave) as connector, pytest.raises(ConnectorError, match=text):
            read_word(connector)


def rtu(device: Device, *, early: bytes = b"", spoil: int = 0) -> hostile.Behaviour:
    """Return a device that speaks RTU; ``early`` comes before the first answer."""

    def behave(client: socket.socket) -> None:
        first = early
        while request := client.recv(300):
            assert crc(request[:-2]) == request[-2:]
            answer = request[:1] + device.answer(request[1:-2])
            checksum = bytes(one ^ spoil for one in crc(answer))
            client.sendall(first + answer + checksum)
            first = b""

    return behave


def test_the_checksum_of_rtu_is_that_of_the_standard() -> None:
    assert crc(bytes.fromhex("0207")) == bytes.fromhex("4112")  # "MODBUS over Serial Line V1.02", appendix B
    assert crc(bytes.fromhex("010300000001")) == bytes.fromhex("840a")


def test_rtu_over_tcp() -> None:
    device = Device({1, 3, 5, 6, 15, 16})
    with connected(rtu(device), framing="rtu") as connector:
        for path, value in VALUES.items():
            assert write(connector, path, value) == [""], path
        assert values(connector) == VALUES
        device.known.clear()
        (refusal,) = write(connector, "first", 1)
        assert "functions 6 and 16: illegal function" in refusal


def test_rtu_with_a_wrong_checksum_unit_or_length_is_no_value() -> None:
    for early, spoil, text in (
        (b"", 1, "wrong checksum"),
        (b"\2\3\2\0\0\0\0", 0, "unit 2 instead of 1"),
        (b"\1\4\2\0\0\0\0", 0, "function 4 instead of 3"),
        (b"\1\3\4\0\0\0\0", 0, "4 bytes of data instead of"),
    ):
        behave = rtu(Device({3}), early=early, spoil=spoil)
        with connected(behave, framing="rtu") as connector, pytest.raises(ConnectorError, match=text):
            read_word(connector)


def test_what_comes_before_a_request_of_rtu_is_no_answer() -> None:
    device = Device({1, 3})
    device.words[0] = 1
    late = b"\1\3\2\0\x63"
    sent = []

    def behave(client: socket.socket) -> None:
        while request := client.recv(300):
            answer = request[:1] + device.answer(request[1:-2])
            client.sendall(answer + crc(answer))
            client.sendall(late + crc(late))  # the same once more, with another value
            sent.append(1)

    with connected(behave, framing="rtu") as connector:
        for _ in range(3):
            assert read_word(connector) == b"\0\1"
            peek(connector)  # wait until it is there


@pytest.mark.parametrize(
    "answer", [bytes.fromhex("0103021234b533"), bytes.fromhex("018302c0f1")], ids=["word", "exception"]
)
def test_an_answer_in_rtu_is_recognized(answer: bytes) -> None:
    text = 'the answer is a frame of Modbus RTU: write framing = "rtu"'
    with connected(hostile.sends(answer), timeout=300) as connector, pytest.raises(ConnectorError, match=text):
        read_word(connector)


def test_a_device_that_has_never_answered_may_speak_rtu() -> None:
    text = r'no answer within 100 ms .*speaks Modbus RTU over TCP, write framing = "rtu"'
    with connected(hostile.silence, timeout=100) as connector, pytest.raises(ConnectorError, match=text):
        connector.read()
