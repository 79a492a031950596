"""Our own broker in Python, and clients that would fill its memory: they are given up, others hear all."""

from __future__ import annotations

import asyncio
import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import MQTTv311

from shmio.config import Address
from shmio.endpoints.mqtt.broker.amqtt_bounds import FILTER_BYTES, Hub
from shmio.endpoints.mqtt.broker.amqtt_shares import (
    EXCHANGE_BYTES,
    MESSAGE_BYTES,
    TASK_BYTES,
    UNHANDLED_BYTES,
    Bound,
    Waiting,
)
from shmio.endpoints.mqtt.broker.amqtt_streams import MAX_FIELDS
from shmio.segment import Segment
from tests.unit.endpoints.mqtt.harness import PREFIX, TIMEOUT_S, Listener, listening
from tests.unit.endpoints.mqtt.serving import Raw, bridged, serving
from tests.unit.endpoints.mqtt.serving import address as address  # noqa: PLC0414  the fixture
from tests.unit.endpoints.mqtt.serving import segment as segment  # noqa: PLC0414  the fixture

MODULE = "shmio.endpoints.mqtt.broker.amqtt_bounds"


@pytest.fixture(autouse=True)
def in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")


@pytest.fixture
def hubs(monkeypatch: pytest.MonkeyPatch) -> list[Hub]:
    """The brokers that are made."""
    made: list[Hub] = []
    make = Hub.__init__

    def making(self: Hub, *arguments: Any) -> None:
        made.append(self)
        make(self, *arguments)

    monkeypatch.setattr(Hub, "__init__", making)
    return made


@pytest.mark.parametrize("bound", [Bound(1 << 20, 64 << 20), Bound(8 << 20, 1 << 20)], ids=["one", "together"])
def test_a_client_that_never_reads_is_ended_and_others_hear_all(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch, bound: Bound
) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.broker.amqtt_streams.UNREAD", bound)
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


def test_who_publishes_faster_than_that_goes_is_slowed_down_and_nothing_is_lost(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, waits = threading.Event(), list[int]()
    broadcast, room = Hub._run_broadcast, Waiting.room

    async def late(self: Any, tasks: Any) -> None:
        """Hand nothing on until the publisher is through, or has to wait."""
        await asyncio.to_thread(go_on.wait, TIMEOUT_S)
        await broadcast(self, tasks)

    async def watched(self: Any) -> None:
        waits.append(self.bytes)
        if not self._room.is_set():
            go_on.set()
        await room(self)

    monkeypatch.setattr(Hub, "_run_broadcast", late)
    monkeypatch.setattr(Waiting, "room", watched)
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
    assert UNHANDLED_BYTES < max(waits) < 4 * UNHANDLED_BYTES, "of 20 MB"


def test_a_packet_that_is_too_large_ends_its_connection_and_is_not_taken_for_packets(
    segment: Segment, address: Address
) -> None:
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


def seen_at(address: Address, topics: str, last: str) -> list[str]:
    """What is retained there, up to ``last``, which is retained after all others."""
    with listening(address, f"{PREFIX}/{topics}/#", protocol=MQTTv311) as listener:
        listener.until(f"{topics}/{last}")
        return [topic.removeprefix(f"{PREFIX}/{topics}/") for topic, _ in listener.heard]


def told(caplog: pytest.LogCaptureFixture, client: str) -> list[str]:
    """What the log tells of a client."""
    return [line for line in caplog.messages if line.startswith(f"client {client!r} at 127.0.0.1:")]


@pytest.mark.parametrize("together", [False, True])
def test_who_has_too_much_retained_is_heard_but_retained_no_more(
    segment: Segment,
    address: Address,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    together: bool,
) -> None:
    room = 10 * MESSAGE_BYTES
    monkeypatch.setattr(f"{MODULE}.RETAINED", Bound(1 << 30, room) if together else Bound(room, 1 << 30))
    with (
        serving(segment, address, "embedded") as process,
        bridged(segment),
        listening(address, protocol=MQTTv311) as listener,
        Raw(address, "full") as full,
    ):
        listener.shown("cell/axis/position/out", "0.0")
        for number in range(20):
            full.publish(f"{PREFIX}/own/{number}", b"1", retain=True)
        listener.until("own/19")
        process.until_refused(11)
        assert len(told(caplog, "full")) == 1
        full.publish(f"{PREFIX}/own/0", b"x" * room, retain=True)  # has no room either: what was retained is not so now
        for topic in ("own/1", "own/2"):
            full.publish(f"{PREFIX}/{topic}", b"", retain=True)
        full.publish(f"{PREFIX}/own/last", b"1", retain=True)
        listener.until("own/last")
        assert seen_at(address, "own", "last") == ["3", "4", "5", "6", "7", "8", "last"]
        if not together:
            with Raw(address, "other") as other:
                other.publish(f"{PREFIX}/others/last", b"1", retain=True)
                listener.until("others/last")
            assert seen_at(address, "others", "last") == ["last"]
        with listening(address, protocol=MQTTv311) as late:
            late.until("cell/step/out", b"7")  # what the bridge publishes has always room


def test_a_client_has_so_many_subscriptions_and_others_have_theirs(
    segment: Segment,
    address: Address,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    hubs: list[Hub],
) -> None:
    monkeypatch.setattr(f"{MODULE}.SUBSCRIBED_BYTES", 10 * (FILTER_BYTES + len("a/00")))
    with (
        serving(segment, address, "embedded") as process,
        listening(address, f"{PREFIX}/mine", protocol=MQTTv311) as listener,
        Raw(address, "greedy") as greedy,
    ):
        topics = [f"a/{number:02}" for number in range(20)]
        assert greedy.subscribe(*topics) == b"\1" * 10 + b"\x80" * 10
        process.until_refused(10)
        assert len(told(caplog, "greedy")) == 1
        assert greedy.subscribe(topics[0]) == b"\1", "it has that already"
        with Raw(address, "modest") as modest:
            assert modest.subscribe(topics[-1]) == b"\1"
        greedy.unsubscribe(*topics)
        assert greedy.subscribe(*topics[10:]) == b"\1" * 10
        greedy.unsubscribe(*topics)
        greedy.ping()
        listener.publish("mine", "still")
        listener.until("mine", b"still")
        assert set(hubs[0].subscriptions) <= {f"{PREFIX}/mine", topics[-1]}, "nothing is left of those that ended"


def test_a_packet_of_too_many_topics_ends_its_connection(segment: Segment, address: Address) -> None:
    with (
        serving(segment, address, "embedded") as process,
        listening(address, f"{PREFIX}/mine", protocol=MQTTv311) as listener,
        Raw(address, "greedy") as greedy,
    ):
        with pytest.raises(ConnectionError):
            greedy.subscribe(*["a"] * (MAX_FIELDS // 3 + 1))
        process.until_refused(1)
        listener.publish("mine", "still")
        listener.until("mine", b"still")


def releasing(listener: Listener, count: int) -> None:
    """Publish as one does with QoS 2."""
    for number in range(count):
        listener.client.publish(f"{PREFIX}/mine", str(number), 2).wait_for_publish(TIMEOUT_S)
        listener.until("mine", str(number).encode())


def test_who_does_not_release_messages_of_qos_2_is_ended_and_those_of_others_come(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(f"{MODULE}.UNFINISHED", Bound(20 * EXCHANGE_BYTES, 1 << 30))
    with (
        serving(segment, address, "embedded") as process,
        listening(address, f"{PREFIX}/mine", protocol=MQTTv311, qos=2) as listener,
        Raw(address, "silent") as silent,
    ):
        with suppress(ConnectionError):
            for _ in range(100):
                silent.publish(f"{PREFIX}/mine", b"never", qos=2)
        assert silent.ended()
        process.until_refused(1)
        assert len(told(caplog, "silent")) == 1
        releasing(listener, 50)
        assert "never" not in listener.values("mine")


def test_all_together_leave_so_much_of_qos_2_unfinished_and_who_leaves_little_is_not_ended(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{MODULE}.UNFINISHED", Bound(1 << 30, 1000 * EXCHANGE_BYTES))
    with (
        serving(segment, address, "embedded") as process,
        listening(address, f"{PREFIX}/mine", protocol=MQTTv311, qos=2) as listener,
        Raw(address, "a") as first,
        Raw(address, "b") as second,
        Raw(address, "c") as modest,
    ):
        modest.publish(f"{PREFIX}/theirs", b"", qos=2)
        for _ in range(700):
            first.publish(f"{PREFIX}/theirs", b"", qos=2)
        first.ping()
        with suppress(ConnectionError):
            for _ in range(700):
                second.publish(f"{PREFIX}/theirs", b"", qos=2)
        assert second.ended()
        process.until_refused(1)
        first.ping()
        modest.ping()
        releasing(listener, 3)


def test_what_comes_behind_a_message_that_is_never_released_is_bounded_too(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The library keeps a task of each packet, as long as an older one has not ended."""
    monkeypatch.setattr(f"{MODULE}.UNFINISHED", Bound(2 * EXCHANGE_BYTES + 50 * TASK_BYTES, 1 << 30))
    with (
        serving(segment, address, "embedded"),
        listening(address, f"{PREFIX}/mine", protocol=MQTTv311, qos=2) as listener,
        Raw(address, "silent") as silent,
    ):
        releasing(listener, 30)  # each of which is four packets
        silent.publish(f"{PREFIX}/theirs", b"", qos=2)
        with suppress(ConnectionError):
            for _ in range(100):
                silent.publish(f"{PREFIX}/theirs", b"")
        assert silent.ended()
        releasing(listener, 3)


def test_so_many_sessions_are_kept_of_clients_that_are_away_and_what_is_kept_for_them_is_bounded(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch, hubs: list[Hub]
) -> None:
    monkeypatch.setattr(f"{MODULE}.MAX_AWAY", 2)
    monkeypatch.setattr(f"{MODULE}.KEPT", Bound(4 * MESSAGE_BYTES, 1 << 30))
    names = ["a", "b", "c"]
    with (
        serving(segment, address, "embedded") as process,
        listening(address, f"{PREFIX}/mine", protocol=MQTTv311) as listener,
    ):
        for name in names:
            with Raw(address, name, clean=False) as away:
                assert not away.before
                away.subscribe(f"{PREFIX}/mine")
                away.send(0xE0, b"")
                assert away.ended()
        process.until_refused(1)
        with Raw(address, "nothing", clean=False) as away:  # it has not subscribed: nothing can come for it
            away.send(0xE0, b"")
            assert away.ended()
        for number in range(10):
            listener.publish("mine", str(number))
            listener.until("mine", str(number).encode())
        assert hubs[0].sessions["a"][0].retained_messages_count == 4
        for name in [*names, "nothing"]:
            with Raw(address, name, clean=False) as back:
                assert back.before is (name in names[:2])
        process.until_refused(1)


def test_who_is_not_let_in_leaves_nothing(segment: Segment, address: Address, tmp_path: Path, hubs: list[Hub]) -> None:
    accounts = tmp_path / "accounts"
    accounts.write_text("anna:secret\n")
    accounts.chmod(0o600)
    with (
        serving(segment, address, "embedded", password_file=str(accounts), account=[]),
        Raw(address, "3", account=("anna", "secret")) as known,
    ):
        for number in range(6):
            with Raw(address, str(number), clean=bool(number % 2)) as stranger:
                assert stranger.code == 5
                assert stranger.ended()
        with Raw(address, "3", account=("anna", "wrong")) as stranger:
            assert stranger.code == 5
        known.ping()
        assert list(hubs[0].sessions) == ["3"]


@pytest.mark.parametrize("topic", [b"", b"a/#", b"a/+/b", b"\xff", b"a\0b", b"$SYS/x"])
@pytest.mark.parametrize("qos", [0, 1, 2])
def test_what_is_published_on_no_topic_ends_its_connection(
    segment: Segment, address: Address, topic: bytes, qos: int
) -> None:
    with serving(segment, address, "embedded"), Raw(address, "odd") as odd, Raw(address, "other") as other:
        odd.subscribe(f"{PREFIX}/mine")
        odd.send(0x30 | qos << 1, len(topic).to_bytes(2, "big") + topic + (odd.number() if qos else b"") + b"1")
        if qos == 2:
            odd.send(0x62, b"\0\2")  # PUBREL
        assert odd.ended()
        other.ping()
