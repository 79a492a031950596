"""Units behind a gateway that do not answer, or answer late."""

from __future__ import annotations

import socket
import time
from contextlib import closing

import pytest

from shmio.connectors.modbus.connector import GATEWAY_RETRY_NS, MAX_UNIT_RETRY_NS, ModbusConnector, ModbusOptions
from shmio.errors import ConnectorError
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec
from shmio.model.statuses import BAD_TIMEOUT, GOOD, StatusArea
from tests.unit.connectors import hostile

TIMEOUT_MS = 600
LAYOUT = place_tags(
    "plant", {f"u{unit}": {"type": "UINT", "address": f"unit {unit} holding 0"} for unit in (1, 2, 3)}
).with_statuses()
BAD = hex(BAD_TIMEOUT)


class Gateway:
    """Answers each unit with its number, and holds back the answers of silent units."""

    def __init__(self) -> None:
        self.silent: set[int] = set()
        self.asked: list[int] = []
        self.held: list[bytes] = []
        self.late: list[bytes] = []
        """Frames to send before the next answer."""
        self.overtaken: list[bytes] = []
        """Frames to send after the next answer."""

    def __call__(self, client: socket.socket) -> None:
        while request := client.recv(300):
            unit = request[6]
            self.asked.append(unit)
            answer = request[:4] + b"\0\x05" + request[6:8] + b"\x02" + unit.to_bytes(2, "big")
            if unit in self.silent:
                self.held.append(answer[:-1] + b"\x63")  # a value that nobody may see
                continue
            late, self.late = self.late, []
            overtaken, self.overtaken = self.overtaken, []
            client.sendall(b"".join(late) + answer + b"".join(overtaken))

    def units(self) -> list[int]:
        """Return the units that were asked since the last call."""
        asked, self.asked = self.asked, []
        return asked


def source(port: int) -> ModbusConnector:
    return ModbusConnector(ModbusOptions(host="127.0.0.1", port=port, timeout=TIMEOUT_MS), LAYOUT)


def values(connector: ModbusConnector) -> list[object]:
    image = connector.read()
    area = StatusArea(LAYOUT)
    return [
        codec(register, LAYOUT.byte_order).decode(image) if (code := area.get(image, index).code) == GOOD else hex(code)
        for index, register in enumerate(LAYOUT.registers)
    ]


def test_a_silent_unit_costs_only_itself_and_is_asked_ever_more_rarely(monkeypatch: pytest.MonkeyPatch) -> None:
    real, ahead_ns = time.monotonic_ns, [0]
    monkeypatch.setattr(time, "monotonic_ns", lambda: real() + ahead_ns[0])
    gateway = Gateway()
    with hostile.peer(gateway) as address, closing(source(address.port)) as connector:
        connector.connect()
        assert values(connector) == [1, 2, 3]
        gateway.silent = {2}
        begun_ns = real()
        assert values(connector) == [1, BAD, 3]
        assert real() - begun_ns < TIMEOUT_MS * 1_000_000
        gateway.units()
        assert values(connector) == [1, BAD, 3]
        assert gateway.units() == [1, 3]
        pause_ns = GATEWAY_RETRY_NS
        for _ in range(6):
            ahead_ns[0] += pause_ns
            assert values(connector) == [1, BAD, 3]
            assert gateway.units() == [1, 3, 2]  # the silent unit is last: the others do not wait for it
            pause_ns = min(2 * pause_ns, MAX_UNIT_RETRY_NS)
            ahead_ns[0] += pause_ns - GATEWAY_RETRY_NS
            assert values(connector) == [1, BAD, 3]
            assert gateway.units() == [1, 3]
            ahead_ns[0] -= pause_ns - GATEWAY_RETRY_NS
        gateway.silent = set()
        ahead_ns[0] += pause_ns
        assert values(connector) == [1, 2, 3]


def test_a_late_answer_is_discarded_once_and_never_becomes_a_value() -> None:
    gateway = Gateway()
    gateway.silent = {2}
    with hostile.peer(gateway) as address, closing(source(address.port)) as connector:
        connector.connect()
        assert values(connector) == [1, BAD, 3]
        gateway.late = gateway.held[:1]
        assert values(connector) == [1, BAD, 3]
        gateway.late = gateway.held[:1]  # the same answer once more is a fault
        with pytest.raises(ConnectorError, match="a request that is not in flight"):
            connector.read()


def test_answers_out_of_order_reach_their_units() -> None:
    """As from an overloaded gateway: an answer that comes after that of the next unit belongs to nobody any more."""
    gateway = Gateway()
    gateway.silent = {2}
    with hostile.peer(gateway) as address, closing(source(address.port)) as connector:
        connector.connect()
        assert values(connector) == [1, BAD, 3]
        gateway.overtaken = gateway.held[:1]
        assert values(connector) == [1, BAD, 3]
        assert values(connector) == [1, BAD, 3]
        assert not connector._client._abandoned


def test_a_late_answer_of_another_unit_is_a_fault() -> None:
    gateway = Gateway()
    gateway.silent = {2}
    with hostile.peer(gateway) as address, closing(source(address.port)) as connector:
        connector.connect()
        assert values(connector) == [1, BAD, 3]
        gateway.late = [gateway.held[0][:6] + b"\x03" + gateway.held[0][7:]]
        with pytest.raises(ConnectorError, match="does not belong to the request"):
            connector.read()


def test_only_if_all_units_are_silent_the_connection_is_lost() -> None:
    gateway = Gateway()
    gateway.silent = {1, 2}
    with hostile.peer(gateway) as address, closing(source(address.port)) as connector:
        connector.connect()
        assert values(connector) == [BAD, BAD, 3]
        gateway.silent = {1, 2, 3}
        begun = time.monotonic()
        with pytest.raises(ConnectorError, match="no answer from any of 3 units"):
            connector.read()
        assert time.monotonic() - begun < 2 * TIMEOUT_MS / 1000
        connector.close()
        gateway.silent = set()
        connector.connect()
        assert values(connector) == [1, 2, 3]
