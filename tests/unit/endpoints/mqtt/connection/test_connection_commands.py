"""Commands have their own connection, so that trouble on it does not affect values, and vice versa."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from contextlib import suppress

import pytest
from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion

from shmio.backoff import Backoff
from shmio.config import Address
from shmio.connectors.injection_layers import Owner
from shmio.model.values import WRITERS
from shmio.segment import Segment
from shmio.testing.mosquitto import Mosquitto
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.mqtt.harness import PREFIX, TIMEOUT_S, bridge, listening
from tests.unit.endpoints.plant import Plant

CONNACK = b"\x20\x03\0\0\0"
FLOOD = 20_000
FRAMES = 20
IN_FLIGHT = 5
"""Number of messages without acknowledgement. It is less than the number of frames published."""


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.reconnect.RECONNECT", Backoff(0.02, 0.1))


def flood(address: Address, qos: int) -> None:
    """Send commands faster than a bridge can process them. Return when the broker has received all."""
    topic = f"{PREFIX}/cell/axis/speed/in".encode()
    packets = []
    for number in range(1, FLOOD + 1):
        body = len(topic).to_bytes(2, "big") + topic + (number.to_bytes(2, "big") if qos else b"") + b"1.5"
        packets.append(bytes([0x30 | qos << 1, len(body)]) + body)
    with socket.create_connection((address.host, address.port), timeout=TIMEOUT_S) as client:
        client.sendall(b"\x10\x10\0\x04MQTT\x04\x02\0\0\0\x04rude" + b"".join(packets) + b"\xc0\0")
        answer = b""
        while not answer.endswith(b"\xd0\0"):  # the answer to the ping that follows them
            answer += client.recv(1 << 16)


class Narrow:
    """A broker that serves one client and acknowledges nothing.

    ``lets_in``: it accepts other clients, too.
    """

    def __init__(self, *, lets_in: bool = False) -> None:
        self.heard = b""
        self._lets_in = lets_in
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = Address("127.0.0.1", self._server.getsockname()[1])
        self._threads = [threading.Thread(target=self._serve)]
        self._threads[0].start()

    def _serve(self) -> None:
        one, _ = self._server.accept()
        self._threads.append(threading.Thread(target=self._turn_away))
        self._threads[1].start()
        with one:
            one.recv(1000)
            one.sendall(CONNACK)
            while data := one.recv(1 << 16):
                self.heard += data

    def _turn_away(self) -> None:
        data = b"?"
        while data:
            another, _ = self._server.accept()
            with another:
                data = another.recv(1000)
                with suppress(ConnectionError):  # the client may leave before it reads its CONNACK
                    if data and self._lets_in:
                        another.sendall(CONNACK)
                        while another.recv(1000):
                            pass

    def close(self) -> None:
        with socket.create_connection((self.address.host, self.address.port)):
            pass
        for thread in self._threads:
            thread.join()
        self._server.close()


@pytest.mark.parametrize("qos", [0, 1])
def test_a_flood_of_commands_delays_no_value(segment: Segment, make_broker: Callable[..., Mosquitto], qos: int) -> None:
    """The broker queues only commands, neither values nor their acknowledgements."""
    broker = make_broker("allow_anonymous true", f"max_inflight_messages {IN_FLIGHT}", "max_queued_messages 0")
    plant = Plant(segment.writer("cell"))
    plant.owners[WRITERS["mqtt"]] = Owner(WRITERS["mqtt"], 3)
    plant.cycle()
    try:
        with (
            listening(broker.address, f"{PREFIX}/cell/step/out") as listener,
            bridge(segment, broker.address) as running,
        ):
            listener.until("cell/step/out", b"0")
            flood(broker.address, qos)
            for step in range(1, FRAMES + 1):
                plant.memory[12:14] = step.to_bytes(2, "big")
                plant.cycle()
                listener.until("cell/step/out", str(step).encode())
            assert 0 < running.bridge.counters[1] < FLOOD
            assert running.bridge.counters[7] == 0
    finally:
        plant.stop()
    assert listener.values("cell/step/out") == [str(step) for step in range(FRAMES + 1)]
    assert plant.written


def test_values_are_published_though_the_broker_accepts_no_second_connection(segment: Segment) -> None:
    segment.writer("cell").publish(image(step=1), cycle=1)
    broker = Narrow()
    with bridge(segment, broker.address) as running:
        running.until(lambda: f"{PREFIX}/cell/secret/out".encode() in broker.heard)
        assert broker.heard.index(b"online") < broker.heard.index(b"cell/step/out")
        assert running.bridge.problem.startswith("commands: broker")
    broker.close()


def test_values_are_published_though_the_broker_never_answers_subscribe(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.connection.SUBSCRIBE_S", 0.1)
    segment.writer("cell").publish(image(step=1), cycle=1)
    broker = Narrow(lets_in=True)
    with bridge(segment, broker.address) as running:
        running.until(lambda: f"{PREFIX}/cell/secret/out".encode() in broker.heard)
        running.until(lambda: "it does not answer to SUBSCRIBE" in running.bridge.problem)
    broker.close()


def test_a_lost_command_connection_is_reopened_and_values_continue(segment: Segment, broker: Mosquitto) -> None:
    plant = Plant(segment.writer("cell"))
    plant.owners[WRITERS["mqtt"]] = Owner(WRITERS["mqtt"], 3)
    plant.run()
    name = f"shmio-{segment.instance}-commands"
    rival = Client(CallbackAPIVersion.VERSION2, name, protocol=MQTTv5, reconnect_on_failure=False)
    gone = threading.Event()
    rival.on_disconnect = lambda *_: gone.set()
    try:
        with listening(broker.address) as listener, bridge(segment, broker.address) as running:
            listener.until("cell/secret/out")
            rival.connect(broker.address.host, broker.address.port)
            rival.loop_start()
            assert gone.wait(TIMEOUT_S)  # the rival replaces the bridge's client, which then replaces the rival
            running.until(lambda: running.bridge.command_connection.connection.subscribed)
            listener.publish("cell/step/in", "5")
            assert listener.json("cell/step/in/result")["done"]
            listener.shown("cell/step/out", "5")
            assert running.bridge.counters[6] == 1
    finally:
        rival.loop_stop()
        rival.on_disconnect = None
        plant.stop()
