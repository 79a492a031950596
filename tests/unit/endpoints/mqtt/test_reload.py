"""Reloads: sources are added, removed and changed, and obsolete retained topics are cleared."""

from __future__ import annotations

import threading

import pytest

from shmio.backoff import Backoff
from shmio.config import MqttTopic
from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, Segment
from shmio.testing.mosquitto import Mosquitto
from shmio.testing.proxy import FaultProxy
from tests.unit.endpoints.harness import STALE_NS, WRITABLE, image
from tests.unit.endpoints.mqtt.harness import PREFIX, bridge, listening

SMALLER = Layout(
    "DB1",
    1,
    8,
    False,
    (Register("axis/position", "REAL", (), 0, None, 4, 1), Register("step", "INT", (), 4, None, 2, 1)),
)


def test_a_changed_source_continues_and_topics_of_removed_registers_are_cleared(
    segment: Segment, broker: Mosquitto
) -> None:
    segment.writer("cell").publish(image(position=1.5, step=3), cycle=1)
    with Segment.open(segment.instance, writable=True) as opened, listening(broker.address) as listener:
        with bridge(opened, broker.address):
            listener.until("cell/secret/out", b"0")
            spec = BlockSpec("cell", SMALLER, 10_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
            other = BlockSpec("other", SMALLER, 10_000_000, STALE_NS, 1 << 20, Attributes("test", ()))
            segment.change(retire=["cell"], add=[spec, other])
            segment.writer("cell").publish(b"\x40\x00\x00\x00\x00\x09\x00\x00", cycle=2)
            segment.writer("other").publish(b"\x40\x00\x00\x00\x00\x0a\x00\x00", cycle=2)
            listener.shown("cell/step/out", "9")
            listener.shown("other/step/out", "10")
            listener.shown("cell/secret/out", "")
        with listening(broker.address, f"{PREFIX}/#") as later:
            later.publish("end", "")
            later.until("end")
            kept = {topic.removeprefix(f"{PREFIX}/") for topic, payload in later.heard if payload}
    registers = {f"{source}/{name}/out" for source in ("cell", "other") for name in ("axis/position", "step")}
    assert kept == registers | {"status", "cell/status", "other/status"}


def test_topics_of_earlier_rules_are_cleared(segment: Segment, broker: Mosquitto) -> None:
    """The reload restarts the bridge, which must clear topics that no rule updates any more."""
    segment.writer("cell").publish(image(step=1), cycle=1)
    before = [MqttTopic(match="cell/inputs", elements=True), MqttTopic(match="cell", payload="frames")]
    with bridge(segment, broker.address, topic=before) as running:
        running.until(lambda: running.bridge.connection.up and not running.bridge.outbox.busy)
    with listening(broker.address) as listener:
        listener.publish("other/step/out", "1", retain=True)
        listener.publish("cell/step/note", "1", retain=True)
    now = [MqttTopic(match="cell/step", publish=False), MqttTopic(match="cell/axis", payload="structure")]
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=now):
        for topic in ("cell/inputs/0/out", "cell/inputs/1/out", "cell/frames", "cell/step/out", "cell/axis/speed/out"):
            listener.shown(topic, "")
        stay = {
            f"{PREFIX}/{topic}" for topic in ("other/step/out", "cell/step/note", "cell/inputs/out", "cell/axis/out")
        }
        topics: set[str] = set()
        with listening(broker.address) as later:
            while not stay <= topics:
                topics.add(later.message().topic)
    gone = ("cell/inputs/0/out", "cell/frames", "cell/step/out", "cell/axis/speed/out")
    assert not topics & {f"{PREFIX}/{topic}" for topic in gone}


def test_the_topics_of_a_removed_source_are_cleared(segment: Segment, broker: Mosquitto) -> None:
    segment.writer("cell").publish(image(step=3), cycle=1)
    with Segment.open(segment.instance, writable=True) as opened, listening(broker.address) as listener:
        with bridge(opened, broker.address) as running:
            listener.until("cell/secret/out", b"0")
            segment.change(retire=["cell"], add=[])
            listener.shown("cell/secret/out", "")
            running.until(lambda: not running.bridge.outbox.busy and not running.bridge.connection.in_flight)
        with listening(broker.address, f"{PREFIX}/#") as later:
            later.publish("end", "")
            later.until("end")
            assert {topic for topic, payload in later.heard if payload} == {f"{PREFIX}/status"}


def test_topics_of_a_source_removed_during_an_outage_are_cleared_afterwards(
    segment: Segment, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.reconnect.RECONNECT", Backoff(0.1, 0.1))
    segment.writer("cell").publish(image(step=3), cycle=1)
    with (
        Segment.open(segment.instance, writable=True) as opened,
        FaultProxy(broker.address, framing=None) as proxy,
        listening(broker.address) as listener,
        bridge(opened, proxy.address) as running,
    ):
        listener.until("cell/secret/out", b"0")
        proxy.refuse()
        running.until(lambda: bool(running.bridge.problem))
        segment.change(retire=["cell"], add=[])
        running.until(lambda: all(thread.name != "bell-cell" for thread in threading.enumerate()))
        proxy.admit()
        for topic in ("cell/status", "cell/secret/out"):
            listener.until(topic, b"")


def test_commands_reach_an_added_source(segment: Segment, broker: Mosquitto) -> None:
    segment.writer("cell").publish(image(step=3), cycle=1)
    spec = BlockSpec("other", SMALLER, 10_000_000, STALE_NS, 1 << 20, Attributes("test", ()))
    with (
        Segment.open(segment.instance, writable=True) as opened,
        listening(broker.address) as listener,
        bridge(opened, broker.address),
    ):
        listener.until("cell/secret/out", b"0")
        segment.change(retire=[], add=[spec])
        segment.writer("other").publish(bytes(8), cycle=1)
        listener.shown("other/step/out", "0")
        listener.publish("other/step/in", "1")
        assert "not writable" in listener.json("other/step/in/result")["reason"]
