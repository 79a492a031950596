"""Our own broker: mosquitto, and the one in Python; as their process runs them, and as clients see them."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import trustme
from paho.mqtt.client import Client, MQTTv5, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion

from shmio.config import Address, Mqtt, MqttTls
from shmio.endpoints.mqtt import broker, builtin, mosquitto
from shmio.endpoints.mqtt.place import folder
from shmio.errors import ConfigError, EndpointError
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.harness import LAYOUT, STALE_NS, WRITABLE, image
from tests.unit.endpoints.mqtt.harness import PREFIX, TIMEOUT_S, Running, bridge, listening


@pytest.fixture
def segment(instance: str, tmp_path: Path) -> Iterator[Segment]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
    processes = [ProcessSpec("cell", "source"), ProcessSpec("broker", "mqtt"), ProcessSpec("mqtt", "mqtt")]
    with Segment.create(instance, [block], processes, control=str(tmp_path / "a.sock")) as segment:
        segment.writer("cell").publish(image(step=7), cycle=1)
        yield segment
        segment.unlink()


@pytest.fixture
def address() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


class Process:
    """The broker's process, as far as it needs one."""

    def __init__(self, segment: Segment, **config: Any) -> None:
        self.stopping, self.ready = threading.Event(), threading.Event()
        self.failure: Exception | None = None
        self._stops: list[Callable[[], object]] = []
        self._worker: Any = SimpleNamespace(
            name="broker",
            config=config,
            segment=segment,
            log=logging.getLogger("test"),
            stopping=self.stopping,
            on_stop=self._stops.append,
            running=self.ready.set,
            report=lambda *_: None,
        )
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            broker.run(self._worker)
        except Exception as error:  # noqa: BLE001  whatever it is, it is the test's to tell
            self.failure = error
        finally:
            self.ready.set()

    def stop(self) -> None:
        self.stopping.set()
        for stop in self._stops:
            stop()
        self._thread.join(TIMEOUT_S)
        assert not self._thread.is_alive()


@contextmanager
def serving(segment: Segment, address: Address, program: str, **config: Any) -> Iterator[Process]:
    process = Process(segment, broker=program, listen=str(address), **config)
    try:
        assert process.ready.wait(TIMEOUT_S)
        if process.failure is not None:
            raise process.failure
        yield process
    finally:
        process.stop()


@contextmanager
def bridged(segment: Segment) -> Iterator[Running]:
    """A bridge to the broker of this instance."""
    running = Running(segment, Mqtt(listen="127.0.0.1:1", prefix=PREFIX))
    try:
        running.until(lambda: running.bridge.link.up)
        yield running
    finally:
        running.stop()


def test_clients_see_what_the_bridge_publishes(segment: Segment, address: Address, program: str) -> None:
    with serving(segment, address, program), bridged(segment) as running:
        assert running.bridge.link.mqtt5 is (program == "mosquitto")
        with listening(address, protocol=MQTTv311) as listener:
            assert listener.until("cell/step/out") == b"7"
            listener.shown("cell/axis/position/out", "0.0")
    assert not folder(segment).exists()


def test_a_client_hears_only_what_it_has_subscribed_to(segment: Segment, address: Address, program: str) -> None:
    with (
        serving(segment, address, program),
        bridged(segment),
        listening(address, protocol=MQTTv311) as everything,
    ):
        assert everything.until("cell/step/out") == b"7"
        with listening(address, f"{PREFIX}/mine", protocol=MQTTv311) as listener:
            listener.publish("mine", "last")
            listener.until("mine")
            assert listener.heard == [(f"{PREFIX}/mine", b"last")]


def test_a_retained_command_is_not_carried_out_by_either_version(
    segment: Segment, address: Address, program: str
) -> None:
    with serving(segment, address, program):
        with listening(address, "none", protocol=MQTTv311) as before:
            before.publish("cell/step/in", "5", retain=True)
            before.publish("cell/step/in/result", "none")
        with bridged(segment) as running, listening(address, protocol=MQTTv311) as listener:
            listener.publish("cell/secret/in", "5")
            told = listener.json("cell/secret/in/result")
            assert "not writable" in told["reason"]
            assert running.bridge.counters[2] in (1, 2)  # of the retained one the broker says nothing, or it is refused
            assert not listener.values("cell/step/in/result")


def test_only_who_has_an_account_gets_in(segment: Segment, address: Address, program: str, tmp_path: Path) -> None:
    accounts = tmp_path / "accounts"
    accounts.write_text("anna:secret\n")
    accounts.chmod(0o600)
    with serving(segment, address, program, password_file=str(accounts)), bridged(segment):
        with listening(address, protocol=MQTTv311, username="anna", password="secret") as listener:
            assert listener.until("cell/step/out") == b"7"
        assert answer(address, MQTTv311) == "Not authorized"
        assert answer(address, MQTTv311, "anna", "guess") == "Not authorized"
        assert answer(address, MQTTv311, "bert", "secret") == "Not authorized"


def answer(address: Address, protocol: Any, *account: str) -> str:
    """What the broker says to a client that connects."""
    told: list[str] = []
    client = Client(CallbackAPIVersion.VERSION2, protocol=protocol)
    if account:
        client.username_pw_set(*account)
    client.on_connect = lambda _client, _data, _flags, code, _properties: told.append(str(code))
    client.connect(address.host, address.port)
    while not told:
        client.loop(1.0)
    client.disconnect()
    client.loop(0.1)
    return told[0]


def test_the_one_in_python_says_what_it_does_not_speak(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    with serving(segment, address, "embedded"):
        assert answer(address, MQTTv5) == "Unsupported protocol version"
        assert answer(address, MQTTv311) == "Success"


@pytest.mark.parametrize("bound", ["MAX_UNREAD_BYTES", "UNREAD_BYTES"])
def test_a_client_that_never_reads_is_ended_by_the_one_in_python_and_others_hear_all(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch, bound: str
) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    monkeypatch.setattr(f"shmio.endpoints.mqtt.builtin.{bound}", 1 << 20)
    payload = bytes(500_000)
    with (
        serving(segment, address, "embedded"),
        socket.create_connection((address.host, address.port)) as deaf,
        listening(address, f"{PREFIX}/large", protocol=MQTTv311) as listener,
    ):
        deaf.sendall(b"\x10\x10\x00\x04MQTT\x04\x02\x00\x00\x00\x04deaf" + b"\x82\x06\x00\x01\x00\x01#\x00")
        until_bytes(deaf, b"\x90\x03\x00\x01\x00")
        for _ in range(40):
            listener.publish("large", payload)
            assert listener.until("large") == payload
        deaf.settimeout(TIMEOUT_S)
        heard = 0
        with suppress(ConnectionResetError):
            while data := deaf.recv(1 << 20):
                heard += len(data)
        assert heard < 40 * len(payload)


def test_who_publishes_faster_than_that_goes_is_slowed_down_by_the_one_in_python_and_nothing_is_lost(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    go_on, waits = threading.Event(), list[int]()
    broadcast, room = builtin._Broker._run_broadcast, builtin._Unhandled.room

    async def late(self: Any, tasks: Any) -> None:
        """Hand nothing on until the publisher is through, or has to wait."""
        await asyncio.to_thread(go_on.wait, TIMEOUT_S)
        await broadcast(self, tasks)

    async def watched(self: Any) -> None:
        waits.append(self._bytes)
        if not self._room.is_set():
            go_on.set()
        await room(self)

    monkeypatch.setattr(builtin._Broker, "_run_broadcast", late)
    monkeypatch.setattr(builtin._Unhandled, "room", watched)
    topic, payload = f"{PREFIX}/many".encode(), bytes(100_000)
    size = 2 + len(topic) + len(payload)
    head = bytes([0x30, size & 0x7F | 0x80, size >> 7 & 0x7F | 0x80, size >> 14, 0, len(topic)]) + topic
    with (
        serving(segment, address, "embedded"),
        listening(address, f"{PREFIX}/many", protocol=MQTTv311) as listener,
        socket.create_connection((address.host, address.port)) as fast,
    ):
        fast.sendall(b"\x10\x10\x00\x04MQTT\x04\x02\x00\x00\x00\x04fast")
        until_bytes(fast, b"\x20\x02\x00\x00")

        def publish() -> None:
            for number in range(200):
                fast.sendall(head + number.to_bytes(4, "big") + payload[4:])
            go_on.set()

        thread = threading.Thread(target=publish)
        thread.start()
        for number in range(200):
            assert listener.until("many")[:4] == number.to_bytes(4, "big")
        thread.join()
    assert builtin.UNHANDLED_BYTES < max(waits) < 4 * builtin.UNHANDLED_BYTES, "of 20 MB"


def test_a_packet_that_is_too_large_ends_its_connection_and_is_not_taken_for_packets(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    with (
        serving(segment, address, "embedded"),
        listening(address, protocol=MQTTv311) as listener,
        socket.create_connection((address.host, address.port)) as large,
    ):
        large.sendall(b"\x10\x11\x00\x04MQTT\x04\x02\x00\x00\x00\x05large")
        until_bytes(large, b"\x20\x02\x00\x00")
        topic = f"{PREFIX}/hidden".encode()
        hidden = bytes([0x30, len(topic) + 3, 0, len(topic)]) + topic + b"!"
        large.sendall(b"\x30\xff\xff\xff\x01\x00\x01t" + hidden)
        large.settimeout(TIMEOUT_S)
        with suppress(ConnectionResetError):
            assert large.recv(1) == b""
        listener.publish("last", "!")
        listener.until("last")
        assert not listener.values("hidden")


def until_bytes(client: socket.socket, end: bytes) -> None:
    """Read until this has come."""
    read = b""
    while not read.endswith(end):
        read += client.recv(1)


def test_tls_with_certificates_of_both_sides(segment: Segment, address: Address, program: str, tmp_path: Path) -> None:
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    server, client = authority.issue_cert("127.0.0.1"), authority.issue_cert("bridge")
    for name, issued in (("server", server), ("client", client)):
        issued.private_key_pem.write_to_path(tmp_path / f"{name}.key")
        (tmp_path / f"{name}.pem").write_bytes(b"".join(blob.bytes() for blob in issued.cert_chain_pems))
    tls = {key: str(tmp_path / name) for key, name in (("certificate", "server.pem"), ("key", "server.key"))}
    own = MqttTls(
        ca=str(tmp_path / "ca.pem"), certificate=str(tmp_path / "client.pem"), key=str(tmp_path / "client.key")
    )
    with serving(segment, address, program, tls={**tls, "ca": str(tmp_path / "ca.pem")}):
        with bridge(segment, address, tls=own) as running:
            running.until(lambda: running.bridge.link.up and not running.bridge.outbox.busy)
        trustme.CA().cert_pem.write_to_path(tmp_path / "other.pem")
        with bridge(segment, address, tls=MqttTls(ca=str(tmp_path / "other.pem"))) as running:
            running.until(lambda: "its certificate is not to be trusted" in running.bridge.problem)
        with bridge(segment, address, tls=MqttTls(ca=str(tmp_path / "ca.pem"))) as running:
            running.until(lambda: bool(running.bridge.problem))
            assert not running.bridge.link.up
        with bridge(segment, address) as running:
            running.until(lambda: bool(running.bridge.problem))
    with bridge(segment, address, tls=MqttTls(ca=str(tmp_path / "none.pem"))) as running:
        running.until(lambda: "mqtt.tls.ca" in running.bridge.problem)


def test_a_port_that_is_taken_ends_it_with_the_reason(segment: Segment, program: str) -> None:
    with (
        Listening() as taken,
        pytest.raises(EndpointError, match=r"(?i)address already in use|address in use"),
        serving(segment, taken.address, program),
    ):
        pass
    assert not folder(segment).exists()


class Listening:
    """Somebody else's server."""

    def __enter__(self) -> Listening:

        self._socket = socket.create_server(("127.0.0.1", 0))
        self.address = Address("127.0.0.1", self._socket.getsockname()[1])
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


def test_a_mosquitto_that_is_insisted_on_and_not_there_is_told(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    with pytest.raises(ConfigError, match="is not on this machine"), serving(segment, address, "mosquitto"):
        pass


def test_what_mosquitto_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOGNAME", "nobody")  # as some ways to become root leave it
    tls = MqttTls(ca="/c/ca.pem", certificate="/c/c.pem", key="/c/k.pem")
    text = mosquitto.configuration(Mqtt(listen="[::1]:1883", password_file="/c/a", tls=tls), tmp_path)
    lines = text.splitlines()
    own, others = lines.index(f"listener 0 {tmp_path / 's'}"), lines.index("listener 1883 ::1")
    assert lines[own + 1 :] == ["allow_anonymous true"]
    assert lines[others + 1 : own] == [
        "allow_anonymous false",
        f"password_file {tmp_path / 'accounts'}",
        "certfile /c/c.pem",
        "keyfile /c/k.pem",
        "cafile /c/ca.pem",
        "require_certificate true",
    ]
    assert "persistence false" in lines[:others]
    assert "user root" in lines[:others]
