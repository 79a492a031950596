"""The connection to the broker, without a bridge."""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from shmio.backoff import Backoff
from shmio.config import Mqtt
from shmio.endpoints.mqtt.connection.connection import BrokerConnection
from shmio.endpoints.mqtt.connection.reconnect import ReconnectPolicy, targets
from shmio.endpoints.mqtt.topics import Message

TIMEOUT_S = 30


def test_a_connection_made_after_the_end_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A name server may answer after the bridge has ended."""
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
        policy = ReconnectPolicy(settings, "test", targets(settings, ""))
        connection = BrokerConnection(policy, selector, woken.set, lambda: Message("will", b"", 1, retain=True), 1)
        connection.run_once()
        assert asked.wait(TIMEOUT_S)
        connection.close()
        answered.set()
        accepted, _ = server.accept()
        with accepted:
            accepted.settimeout(TIMEOUT_S)
            while accepted.recv(1000):
                pass
        assert not woken.is_set()


class Broker:
    """The broker's end of a connection. The test sends and reads its packets (MQTT 5.0, section 3)."""

    def __init__(self, server: socket.socket) -> None:
        self._server = server
        self._selector = selectors.DefaultSelector()
        settings = Mqtt(broker="external", host=f"127.0.0.1:{server.getsockname()[1]}")
        policy, will = ReconnectPolicy(settings, "test", targets(settings, "")), Message("will", b"", 1, retain=True)
        self.connection = BrokerConnection(policy, self._selector, lambda: None, lambda: will, 1)
        self.admit()

    def admit(self) -> None:
        """Accept a connection."""
        self.connection.run_once()
        self._socket, _ = self._server.accept()
        self._socket.settimeout(TIMEOUT_S)
        self.hear(0x10)
        self.say("20 03 00 00 00", lambda: self.connection.up)

    def hang_up(self) -> None:
        """Close the connection without a DISCONNECT packet."""
        self._socket.close()
        self.turn_until(lambda: not self.connection.up)

    def hear(self, kind: int, count: int = 1) -> None:
        """Read this many packets of a kind. Fail if another packet follows."""
        for _ in range(count):
            assert self._socket.recv(1)[0] & 0xF0 == kind
            length = shift = 0
            while (byte := self._socket.recv(1)[0]) & 0x80:
                length, shift = length | (byte & 0x7F) << shift, shift + 7
            length |= byte << shift
            while length:
                length -= len(self._socket.recv(length))

    def expect(self, data: bytes) -> None:
        """Assert that exactly these bytes arrive next."""
        got = b""
        while len(got) < len(data):
            got += self._socket.recv(len(data) - len(got))
        assert got == data

    def put(self, packet: str) -> None:
        self._socket.sendall(bytes.fromhex(packet))

    def say(self, packet: str, until: Callable[[], bool]) -> None:
        """Send a packet, and let the connection work until the packet takes effect."""
        self.put(packet)
        self.turn_until(until)

    def silent(self) -> None:
        """Assert that no data has arrived."""
        self._socket.setblocking(False)
        with pytest.raises(BlockingIOError):
            self._socket.recv(1)
        self._socket.settimeout(TIMEOUT_S)

    def turn_until(self, until: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + TIMEOUT_S
        while not until():
            assert time.monotonic() < deadline_s
            self.turn(0.1)

    def turn(self, wait_s: float = 0.0) -> int:
        """Let the connection work once; return how many events there were."""
        self.connection.run_once()
        found = self._selector.select(wait_s)
        for key, events in found:
            key.data(events)
        return len(found)

    def close(self) -> None:
        self.connection.close()
        self._socket.close()
        self._selector.close()


def test_repeated_disconnections_suggest_another_client_with_the_same_id(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two clients have the same id, and the broker does not say why it disconnects one."""
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.reconnect.RECONNECT", Backoff(0.0, 0.0))
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        try:
            for losses in range(1, 5):
                broker.hang_up()
                assert ("does another client connect as test" in broker.connection.problem) is (losses == 4)
                broker.admit()
        finally:
            broker.close()


def test_a_brokers_refusal_is_reported_as_long_as_it_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The report remains although the broker accepts other messages."""

    def publish(topic: str) -> None:
        connection.send(Message(topic, b"1", 1, retain=True))
        connection.push()
        broker.hear(0x30)

    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        connection = broker.connection
        try:
            publish("secret")
            broker.say("40 03 00 01 87", lambda: not connection.in_flight)
            assert connection.problem.endswith("refuses messages: Not authorized: secret")
            publish("open")
            broker.say("40 02 00 02", lambda: not connection.in_flight)
            assert "secret" in connection.problem
            monkeypatch.setattr("shmio.endpoints.mqtt.connection.connection.REFUSED_S", 0.0)
            publish("open")
            broker.say("40 02 00 03", lambda: not connection.in_flight)
            assert not connection.problem
            connection.subscribe(["a/in", "b/in"])
            connection.push()
            broker.hear(0x80)
            broker.say("90 05 00 04 00 01 87", lambda: bool(connection.problem))
            told = "refuses shmio's subscription, so no command can arrive: Not authorized"
            assert told in connection.problem
            publish("open")
            broker.say("40 02 00 05", lambda: not connection.in_flight)
            assert told in connection.problem
        finally:
            broker.close()


def test_messages_are_sent_on_push_and_returned_when_the_connection_is_lost() -> None:
    lost: list[Message] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        connection = broker.connection
        connection.on_lost = lost.extend
        try:
            messages = [Message(f"t{number}", b"1", 1, retain=True) for number in range(5)]
            for message in messages[:3]:
                connection.send(message)
            broker.silent()
            connection.push()
            broker.hear(0x30, 3)
            broker.say("40 02 00 01", lambda: connection.in_flight == 2)
            for message in messages[3:]:
                connection.send(message)
            broker.say("e0 00", lambda: not connection.up)  # the connection ends before they are sent
            assert lost == messages[1:]
        finally:
            broker.close()


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_acknowledgements_come_in_any_form_and_in_pieces(size: int) -> None:
    """Another packet follows them in the same piece, or begins in it."""
    text = bytes([0x1F, 0x00, 0xC8]) + b"x" * 200  # the property that has the reason as text
    packets = [
        bytes.fromhex("40 02 00 01"),
        bytes.fromhex("40 03 00 02 10"),
        bytes.fromhex("40 04 00 03 00 00"),
        bytes.fromhex("40 d0 01 00 04 00 cb 01") + text,
        bytes.fromhex("40 03 00 05 ee"),
        bytes.fromhex("30 06 00 01 61 00 68 69"),
        bytes.fromhex("40 02 00 06"),
        bytes.fromhex("30 06 00 01 62 00 68 6f"),
    ]
    received: list[tuple[str, bytes]] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        connection = broker.connection
        connection.on_message = lambda message: received.append((message.topic, bytes(message.payload)))
        try:
            for number in range(6):
                connection.send(Message(f"t{number}", b"1", 1, retain=True))
            connection.push()
            broker.hear(0x30, 6)
            data = b"".join(packets)
            for at in range(0, len(data), size):
                broker.put(data[at : at + size].hex())
                connection.run_once()
            broker.turn_until(lambda: len(received) == 2)
            assert (connection.in_flight, received) == (0, [("a", b"hi"), ("b", b"ho")])
            assert connection.problem.endswith("refuses messages: reason code 0xee: t4")
        finally:
            broker.close()


def test_messages_that_arrive_together_are_all_handled() -> None:
    """Although one turn handles only a few, and the socket has nothing more to read."""
    received: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        broker.connection.on_message = lambda message: received.append(bytes(message.payload))
        try:
            broker.put("".join(f"30 05 00 01 61 00 {number:02x}" for number in range(200)))
            broker.turn_until(lambda: len(received) == 200)
            assert received == [bytes((number,)) for number in range(200)]
        finally:
            broker.close()


def test_the_rest_of_an_acknowledgement_is_awaited_without_work() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        try:
            broker.connection.send(Message("t", b"1", 1, retain=False))
            broker.connection.push()
            broker.put("40 02 00")
            assert broker.turn(TIMEOUT_S), "it arrives"
            assert [broker.turn() for _ in range(3)][1:] == [0, 0]
            broker.say("01", lambda: not broker.connection.in_flight)
        finally:
            broker.close()


def test_a_malformed_acknowledgement_ends_the_connection() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        try:
            broker.say("40 01 00", lambda: not broker.connection.up)
        finally:
            broker.close()


def test_joined_messages_arrive_as_they_were_sent() -> None:
    """With QoS 0 and 1, and with other packets between them."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        connection = broker.connection
        try:
            connection.send(Message("a", b"1", 0, retain=False))
            connection.send(Message("b/ä", b"22", 1, retain=True))
            connection.subscribe(["c"])
            connection.send(Message("d", bytes(200), 1, retain=False))
            with pytest.raises(ValueError, match="wildcards"):
                connection.send(Message("e/+", b"", 1, retain=False))
            connection.push()
            expected = (
                "30 05 00 01 61 00 31",
                "33 0b 00 04 62 2f c3 a4 00 01 00 32 32",
                "82 07 00 02 00 00 01 63 2d",
                f"32 ce 01 00 01 64 00 03 00 {'00' * 200}",
            )
            broker.expect(bytes.fromhex("".join(expected)))
        finally:
            broker.close()


def test_acknowledgements_keep_a_connection_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    """The answer to a ping may wait behind large messages for longer than the keep-alive time."""
    now_s = 1000.0
    for clock in ("time.monotonic", "paho.mqtt.client.time_func"):
        monkeypatch.setattr(clock, lambda: now_s)
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        connection = broker.connection
        try:
            for number in range(1, 51):
                now_s += 2.0
                connection.send(Message("t", b"1", 1, retain=False))
                connection.push()
                broker.put(f"40 02 00 {number:02x}")
                broker.turn_until(lambda: not connection.in_flight)
                assert connection.up, connection.problem
        finally:
            broker.close()


def test_sending_stops_while_the_broker_does_not_read() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        connection = broker.connection
        try:
            sent = 0
            while connection.room:
                connection.send(Message("large", bytes(500_000), 0, retain=False))
                connection.push()
                sent += 1
            assert sent > 1
            reading = threading.Thread(target=broker.hear, args=[0x30, sent])
            reading.start()
            broker.turn_until(lambda: connection.room > 0)
            reading.join()
        finally:
            broker.close()


@pytest.mark.parametrize("leave", [BrokerConnection.close, lambda connection: connection.drop("enough", politely=True)])
def test_the_disconnect_is_sent_though_the_brokers_last_data_is_unread(
    leave: Callable[[BrokerConnection], None],
) -> None:
    """Otherwise the broker would publish the will.

    Closing a socket with unread data discards what has not been sent yet.
    """
    with socket.create_server(("127.0.0.1", 0)) as server:
        broker = Broker(server)
        try:
            broker.put("d0 00" * 100)
            leave(broker.connection)
            broker.hear(0xE0)
        finally:
            broker.close()


def test_the_instances_own_broker_is_retried_without_a_long_back_off() -> None:
    own = Mqtt(listen="127.0.0.1:1883")
    policy = ReconnectPolicy(own, "test", targets(own, "/run/own"))
    assert max(policy.wait_s() for _ in range(50)) <= 0.75
    external = Mqtt(broker="external", host="127.0.0.1")
    policy = ReconnectPolicy(external, "test", targets(external, ""))
    assert max(policy.wait_s() for _ in range(50)) > 5
