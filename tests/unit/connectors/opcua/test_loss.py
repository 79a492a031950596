"""Servers that die, hang or send anything but OPC UA: the source notices within its time-outs."""

from __future__ import annotations

import struct
import time
import tracemalloc
from contextlib import ExitStack, suppress

import pytest

from shmio.connectors.base import Lost, WriteLostError
from shmio.errors import ConnectorError
from shmio.layout.values.write import Write
from shmio.testing.conformance import connect
from shmio.testing.proxy import FaultProxy
from shmio.testing.write_conformance import write
from tests.unit.connectors import hostile
from tests.unit.connectors.opcua.device import Device, framing
from tests.unit.connectors.opcua.harness import PATIENCE_S, Source, connected, until

TIMEOUT_MS = 300
MODES = pytest.mark.parametrize("mode", ["subscribe", "poll"])
TAGS = {"count": "UDINT"}


def lost(source: Source) -> str:
    """Wait until there is no image any more; return the reason."""
    found: list[str] = []

    def fails() -> bool:
        try:
            source.connector.read()
        except ConnectorError as error:
            found.append(str(error))
        return bool(found)

    until(fails, "the loss")
    return found[0]


@pytest.fixture(autouse=True, scope="module")
def nodes(device: Device) -> None:
    device.ask("add", "count", "UInt32", 7)


@MODES
def test_a_frozen_server_is_noticed_and_found_again(device: Device, mode: str) -> None:
    with connected(device.url, TAGS, timeout=TIMEOUT_MS, mode=mode) as source:
        assert source.value("count") == 7
        device.freeze()
        try:
            begun = time.monotonic()
            assert "no answer within" in lost(source)
            assert time.monotonic() - begun < TIMEOUT_MS / 1000 + 5
            with pytest.raises(ConnectorError, match="no answer within"):
                source.connector.connect()
        finally:
            device.thaw()
        source.connector.close()
        connect(source.connector)
        assert source.value("count") == 7


def test_a_killed_server_is_noticed_and_found_again() -> None:
    with Device() as device, ExitStack() as stack:
        device.ask("add", "count", "UInt32", 7)
        sources = [
            stack.enter_context(connected(device.url, TAGS, timeout=TIMEOUT_MS, mode=mode))
            for mode in ("subscribe", "poll")
        ]
        assert [source.value("count") for source in sources] == [7, 7]
        device.kill()
        for source in sources:
            lost(source)
            with pytest.raises(ConnectorError, match="connection refused"):
                source.connector.connect()
        device.restart()
        device.ask("add", "count", "UInt32", 8)
        for source in sources:
            connect(source.connector)
            assert source.value("count") == 8


@MODES
def test_an_expired_session_is_lost_and_another_one_begins(device: Device, mode: str) -> None:
    with connected(device.url, TAGS, timeout=TIMEOUT_MS, mode=mode) as source:
        device.ask("expire")
        assert "BadSession" in lost(source)
        source.connector.close()
        connect(source.connector)
        device.ask("set", "count", "UInt32", 8)
        until(lambda: source.value("count") == 8, "a change in the new session")
        device.ask("set", "count", "UInt32", 7)


def test_a_lost_publication_ends_the_session(device: Device) -> None:
    """The server's messages are numbered; without one of them, values may be missing."""
    with (
        FaultProxy(device.address, framing=framing) as proxy,
        connected(f"opc.tcp://{proxy.address}", TAGS) as source,
    ):
        proxy.edit(lambda frame: None, frames=1)
        device.ask("set", "count", "UInt32", 9)
        assert lost(source)
    device.ask("set", "count", "UInt32", 7)


def test_writes_without_a_connection_are_unsent(device: Device) -> None:
    source = Source(device.url, TAGS)
    with pytest.raises(WriteLostError) as raised:
        write(source.connector, [Write(0, 0, bytes(4))])
    assert raised.value.outcomes == (Lost.UNSENT,)


def test_a_link_that_has_just_ended_is_closed_and_lost(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its thread may end between any two steps of the poll thread."""
    with connected(device.url, TAGS, mode="poll") as source:
        link = source.connector._link
        assert link is not None
        link.close()
        link.join(PATIENCE_S)
        monkeypatch.setattr(link, "is_alive", lambda: True)
        with pytest.raises(ConnectorError, match="was closed"):
            source.connector.read()
        source.connector.close()


# -- hostile peers -----------------------------------------------------------------------------------------------------


ACK = b"ACKF" + struct.pack("<IIIIII", 28, 0, 65535, 65535, 0, 0)
HOSTILE = {
    "silence": hostile.silence,
    "closes at once": hostile.closes,
    "HTTP": hostile.sends(b"HTTP/1.1 400 Bad Request\r\n\r\n"),
    "zeros": hostile.sends(bytes(4096)),
    "ones": hostile.sends(b"\xff" * 4096),
    "a huge chunk": hostile.endless(b"ACKF" + struct.pack("<I", 0xFFFFFFF0) + bytes(1 << 16)),
    "a tiny chunk": hostile.sends(b"ACKF" + struct.pack("<I", 0)),
    "an error": hostile.sends(b"ERRF" + struct.pack("<IIi", 16, 0x80830000, -1)),
    "acknowledges without end": hostile.endless(ACK),
    "no bytes allowed": hostile.sends(b"ACKF" + struct.pack("<IIIIII", 28, 0, 1, 1, 1, 1)),
    "a trickle": hostile.trickle(b"ACKF\x1c\0\0\0"),
    "acknowledge, then chunks without end": hostile.endless(
        ACK + b"MSGC" + struct.pack("<IIIII", 65000, 0, 0, 1, 1) + bytes(65000 - 24)
    ),
}


@pytest.mark.parametrize("behave", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_peer_is_refused_in_time_and_costs_little(behave: hostile.Behaviour) -> None:
    with hostile.peer(behave) as address:
        source = Source(f"opc.tcp://{address}", TAGS, timeout=TIMEOUT_MS)
        tracemalloc.start()
        try:
            begun = time.monotonic()
            with pytest.raises(ConnectorError) as raised:
                source.connector.connect()
            assert time.monotonic() - begun < source.connector.timeout_s + 5
            assert str(raised.value)
            assert tracemalloc.get_traced_memory()[1] < 64 << 20
        finally:
            tracemalloc.stop()
            source.connector.close()


@pytest.mark.parametrize("seed", range(8))
def test_damaged_answers_never_become_values(device: Device, seed: int) -> None:
    """A byte of each of the server's chunks is changed; what is read is right, or nothing is."""
    from random import Random

    random = Random(seed)

    def damage(frame: bytes) -> bytes:
        at = random.randrange(8, len(frame))
        return frame[:at] + bytes([frame[at] ^ (1 << random.randrange(8))]) + frame[at + 1 :]

    with FaultProxy(device.address, framing=framing) as proxy:
        source = Source(f"opc.tcp://{proxy.address}", TAGS, timeout=TIMEOUT_MS)
        proxy.edit(damage)
        with suppress(ConnectorError):
            source.connector.connect()
            for _ in range(20):
                source.connector.read()
        source.connector.close()
        proxy.pass_all()
        connect(source.connector)
        assert source.value("count") == 7
        source.connector.close()
