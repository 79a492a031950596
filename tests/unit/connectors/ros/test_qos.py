"""The QoS of the ros2 connector, with nodes that offer and request all kinds of QoS."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, cast

import pytest

from shmio.connectors import registry
from shmio.connectors.ros.dds import Ros2Connector, Ros2Options
from shmio.connectors.ros.qos import QosKeys, qos_of
from shmio.errors import ConfigError, ConnectorError
from shmio.model import statuses
from tests.unit.connectors.ros.dds_peer import DOMAIN, Peer
from tests.unit.connectors.source import Source, layout_of


@pytest.fixture(scope="module")
def shared() -> Iterator[Peer]:
    with Peer() as peer:
        yield peer


@pytest.fixture
def peer(shared: Peer) -> Iterator[Peer]:
    """A node that always publishes on the topic ``mode``, so that sources can connect."""
    yield shared
    for name in shared.ask("opened_names"):
        shared.ask("withdraw", name)


@contextmanager
def connected(peer: Peer, topic: str, *, writable: bool = False, **options: Any) -> Iterator[Source]:
    """Connect a source to a topic with std_msgs/Float64, whose register is ``x``."""
    layout = layout_of({
        "x": {"type": "LREAL", "address": peer.address(topic, "std_msgs/Float64 data"), "writable": writable},
        "mode": ("STRING[20]", peer.address("mode", "std_msgs/String data")),
    })  # fmt: skip
    keys = registry.convert_options("ros2", {"domain": DOMAIN, "timeout": 5000, "max_age": 0} | options)
    source = Source(Ros2Connector(cast("Ros2Options", keys), layout), layout)
    try:
        source.connector.connect()
        yield source
    finally:
        source.connector.close()


def sent(source: Source, peer: Peer, topic: str, value: float) -> None:
    """Send a value until it arrives."""

    def arrived() -> bool:
        peer.ask("send_data", topic, value)
        return source.code("x") == 0 and source.value("x") == value

    source.until(arrived)


OFFERS = [
    ({"reliability": "best_effort"}, {"profile": "default"}, "reliability best_effort, .* reliable"),
    ({}, {"durability": "transient_local", "reliability": "reliable"}, "durability volatile, .* transient_local"),
    ({}, {"deadline_ms": 100}, "deadline none, .* 100 ms; set deadline_ms"),
    ({"deadline": 200}, {"deadline_ms": 100}, "deadline 200 ms, .* 100 ms"),
    ({}, {"liveliness": "manual_by_topic"}, "liveliness automatic, .* manual_by_topic"),
    ({"lease": 3000}, {"liveliness": "manual_by_topic", "lease_ms": 1000}, "lease 3000 ms, .* 1000 ms; set lease_ms"),
]


@pytest.mark.parametrize(("offered", "requested", "words"), OFFERS)
def test_a_publisher_that_offers_too_little_is_reported_by_the_policy(
    peer: Peer, caplog: pytest.LogCaptureFixture, offered: dict[str, Any], requested: dict[str, Any], words: str
) -> None:
    peer.ask("offer", "x", "Float64", offered)
    with connected(peer, "x", topic_qos={f"/{peer.prefix}/x": requested}) as source:
        source.until(lambda: source.code("x") == statuses.BAD_CONFIGURATION_ERROR)
        assert source.code("mode") != statuses.BAD_CONFIGURATION_ERROR
        [found] = [one for one in caplog.messages if "a publisher offers" in one]
        assert re.search(words, found), found
        peer.ask("withdraw", "x")
        peer.ask("offer", "x", "Float64", {"stored": True, "deadline": 50, "lease": 500})
        sent(source, peer, "x", 2.5)


def test_a_publisher_that_does_not_fit_is_reported_if_it_was_discovered_before_the_others(
    peer: Peer, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    participant = pytest.importorskip("shmio.connectors.ros.participant").Participant
    discovered, discover = threading.Event(), participant.discover

    def noticed(self: Any, most: int) -> set[str]:
        found: set[str] = discover(self, most)
        if f"/{peer.prefix}/x" in found:
            discovered.set()
        return found

    monkeypatch.setattr(participant, "discover", noticed)
    peer.ask("offer", "x", "Float64", {"reliability": "best_effort"})
    layout = layout_of({
        name: ("LREAL", peer.address(name, "std_msgs/Float64 data")) for name in ("x", "later")
    })  # fmt: skip
    options = Ros2Options(domain=DOMAIN, timeout=20_000, max_age=0, qos=QosKeys(reliability="reliable"))
    connector = Ros2Connector(options, layout)
    source = Source(connector, layout)
    with ThreadPoolExecutor(1) as pool:
        connecting = pool.submit(connector.connect)
        assert discovered.wait(20)
        peer.ask("offer", "later", "Float64", {})
        connecting.result()
    try:
        source.until(lambda: source.code("x") == statuses.BAD_CONFIGURATION_ERROR)
        assert "a publisher offers reliability best_effort" in caplog.text
    finally:
        connector.close()


def test_a_source_whose_only_publisher_does_not_fit_says_why(peer: Peer) -> None:
    peer.ask("offer", "only", "Float64", {"reliability": "best_effort"})
    peer.ask("offer", "other", "Int16", {})
    layout = layout_of({
        name: ("LREAL", peer.address(name, "std_msgs/Float64 data")) for name in ("only", "other")
    })  # fmt: skip
    options = Ros2Options(domain=DOMAIN, timeout=1500, qos=QosKeys(reliability="reliable"))
    connector = Ros2Connector(options, layout)
    with pytest.raises(ConnectorError, match=r"offers reliability best_effort.*sends std_msgs/Int16"):
        connector.connect()


def test_a_missed_deadline_is_bad_until_the_next_message(peer: Peer, caplog: pytest.LogCaptureFixture) -> None:
    peer.ask("offer", "x", "Float64", {"deadline": 100})
    with connected(peer, "x", topic_qos={f"/{peer.prefix}/x": {"deadline_ms": 100}}) as source:
        sent(source, peer, "x", 1.0)
        source.until(lambda: source.code("x") == statuses.BAD_TIMEOUT)
        assert source.value("x") == 1.0
        assert "missed its deadline of 100 ms" in caplog.text
        sent(source, peer, "x", 2.0)


def test_a_publisher_that_does_not_show_that_it_lives_is_lost(peer: Peer) -> None:
    peer.ask("offer", "x", "Float64", {"lease": 100})
    requested = {"liveliness": "manual_by_topic", "lease_ms": 100}
    with connected(peer, "x", topic_qos={f"/{peer.prefix}/x": requested}) as source:
        sent(source, peer, "x", 1.0)
        source.until(lambda: source.code("x") == statuses.BAD_NO_COMMUNICATION)
        sent(source, peer, "x", 2.0)


def test_commands_are_stored_for_late_subscribers_as_deep_as_configured(peer: Peer) -> None:
    qos = {"durability": "transient_local", "reliability": "reliable", "depth": 2}
    with connected(peer, "x", writable=True, qos=qos) as source, Peer() as late:
        peer.ask("request", "x", "Float64", {"stored": True, "depth": 10})
        for value in (1.0, 2.0, 3.0):
            assert source.write(x=value) == [""]
        late.ask("request", "x", "Float64", {"stored": True, "depth": 10}, peer.prefix)
        found: list[float] = []
        end_s = time.monotonic() + 20
        while found[-1:] != [3.0]:
            found += late.ask("received_all", "x")
            assert time.monotonic() < end_s, found
        assert found == [2.0, 3.0]


@pytest.mark.parametrize(
    ("requested", "words"),
    [({"stored": True}, "durability transient_local, .* volatile; set durability"),
     ({"deadline": 100}, "deadline 100 ms, .* none; change the subscriber"),
     ({"lease": 100}, "liveliness manual_by_topic, .* automatic; change")],
)  # fmt: skip
def test_a_subscriber_that_requests_too_much_is_named_when_a_write_is_refused(
    peer: Peer, requested: dict[str, Any], words: str
) -> None:
    peer.ask("request", "x", "Float64", requested)
    with connected(peer, "x", writable=True) as source:
        found = ""
        end_s = time.monotonic() + 20
        while "requests" not in found:
            assert time.monotonic() < end_s, found
            source.read()
            [found] = source.write(x=1.0)
        assert re.search(words, found), found


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"qos": {"profile": "fast"}}, "qos.profile: .*sensor_data"),
        ({"topic_qos": {"/x": {"profile": "fast"}}}, r"topic_qos.*profile: .*sensor_data"),
        ({"qos": {"depth": 0}}, "qos.depth"),
        ({"qos": {"dept": 1}}, "qos.*dept"),
        ({"qos": {"deadline_ms": 0}}, "qos.deadline_ms"),
        ({"qos": {"history": "keep_all", "depth": 3}}, "depth: .* keep_all"),
        ({"qos": {"durability": "transient_local"}}, "qos: /x: durability: .* reliable"),
        ({"topic_qos": {"/y": {}}}, "topic_qos: unknown topic '/y'"),
        ({"topic_qos": {"/x": {"lifespan_ms": 5}}}, "topic_qos: /x: lifespan_ms: .* max_age"),
        ({"qos": {"lifespan_ms": 5}, "writable": False}, "qos: lifespan_ms: .* no topic"),
        ({"topic_qos": {"/c": {"deadline_ms": 5}}}, "/c: deadline_ms: .* writes the topic"),
        ({"topic_qos": {"/c": {"liveliness": "manual_by_topic"}}}, "/c: liveliness: .* automatic"),
        ({"topic_qos": {"/c": {"profile": "default", "durability": "transient_local", "history": "keep_all"}}},
         "/c: history: .* for ever"),
        ({"latched": ["/x"], "topic_qos": {"/x": {"reliability": "best_effort"}}}, "/x: durability"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_before_anything_starts(options: dict[str, Any], words: str) -> None:
    pytest.importorskip("cyclonedds")
    writable = options.pop("writable", True)
    layout = layout_of({
        "x": ("LREAL", "/x std_msgs/Float64 data"),
        "c": {"type": "LREAL", "address": "/c std_msgs/Float64 data", "writable": writable},
    })  # fmt: skip
    with pytest.raises(ConfigError, match=words):
        Ros2Connector(cast("Ros2Options", registry.convert_options("ros2", options)), layout)


def test_the_nearest_key_counts() -> None:
    source = QosKeys(profile="parameters", lease_ms=500)
    found = qos_of(source, None, latched=False, writable=True)
    assert (found.reliability, found.depth, found.lease_ms) == ("reliable", 1000, 500)
    found = qos_of(source, QosKeys(profile="sensor_data", depth=3), latched=True, writable=True)
    assert (found.reliability, found.durability, found.depth) == ("best_effort", "volatile", 3)
    found = qos_of(QosKeys(), None, latched=True, writable=False)
    assert (found.reliability, found.durability) == ("reliable", "transient_local")
    assert qos_of(QosKeys(deadline_ms=9, lifespan_ms=7), None, latched=False, writable=False).deadline_ms == 9
    found = qos_of(QosKeys(deadline_ms=9, liveliness="manual_by_topic"), None, latched=False, writable=True)
    assert (found.deadline_ms, found.liveliness) == (0, "automatic")
