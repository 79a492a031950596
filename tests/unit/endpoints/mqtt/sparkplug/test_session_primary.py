"""An edge node that waits for its primary host, at a real broker."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from shmio.backoff import Backoff
from shmio.config import Sparkplug
from shmio.segment import Segment
from shmio.testing.mosquitto import Mosquitto
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.mqtt.harness import Listener, bridge, listening
from tests.unit.endpoints.mqtt.sparkplug.test_session import Host, bd_seq

STATE = "spBv1.0/STATE/scada"
NODES = "spBv1.0/plant/#"
WAITING = Sparkplug(group="plant", node="a50", primary_host="scada")


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.reconnect.RECONNECT", Backoff(0.02, 0.1))


def say(listener: Listener, payload: Any, topic: str = STATE) -> None:
    data = payload if isinstance(payload, bytes) else json.dumps(payload)
    listener.client.publish(topic, data, 1, retain=True).wait_for_publish(30)


def online(at_ms: int) -> dict[str, Any]:
    return {"online": True, "timestamp": at_ms}


def offline(at_ms: int) -> dict[str, Any]:
    return {"online": False, "timestamp": at_ms}


def test_a_node_is_born_and_dies_with_its_primary_host_and_keeps_changes(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(step=1), cycle=1)
    with listening(broker.address, NODES) as listener:
        with bridge(segment, broker.address, sparkplug=WAITING) as running:
            host = Host(listener)
            running.until(lambda: "the primary host is offline (spBv1.0/STATE/scada)" in running.bridge.problem)
            for nothing in (
                b"ONLINE",
                b"[" * 5000,
                {"online": "true", "timestamp": 1},
                {"online": True},
                online(2**53),
                offline(5),
            ):
                say(listener, nothing)
            say(listener, online(9), "spBv1.0/STATE/another")
            writer.publish(image(step=2), cycle=2)
            running.until(lambda: running.bridge.counters[4] > 0)
            say(listener, online(10))
            birth = host.next()
            assert birth.kind == "NBIRTH"
            born = host.next()
            assert (born.kind, born.metrics["step"].int_value) == ("DBIRTH", 2)
            while (history := host.next()).metrics["step"].int_value != 2:
                pass
            assert (history.kind, history.metrics["step"].is_historical) == ("DDATA", True)
            running.until(lambda: not running.bridge.problem)

            say(listener, offline(9))  # the late will of an earlier session
            writer.publish(image(step=3), cycle=3)
            assert host.next().metrics["step"].int_value == 3

            say(listener, offline(10))
            death = host.next()
            assert (death.kind, bd_seq(death)) == ("NDEATH", bd_seq(birth))
            running.until(lambda: "the primary host is offline" in running.bridge.problem)
            for step in range(4, 8):
                writer.publish(image(step=step), cycle=step)
            running.until(lambda: "4 changes are kept" in running.bridge.problem)
            say(listener, online(20))
            again = host.next()
            assert (again.kind, bd_seq(again)) == ("NBIRTH", (bd_seq(birth) + 1) % 256)
            assert host.next().metrics["step"].int_value == 7
            told = [host.next() for _ in range(4)]
            assert [one.metrics["step"].int_value for one in told] == [4, 5, 6, 7]
            assert all(one.metrics["step"].is_historical for one in told)
        assert host.next().kind == "NDEATH"


def test_a_host_that_returns_at_once_gets_a_new_birth(segment: Segment, broker: Mosquitto) -> None:
    segment.writer("cell").publish(image(step=1), cycle=1)
    with listening(broker.address, NODES) as listener, bridge(segment, broker.address, sparkplug=WAITING):
        host = Host(listener)
        say(listener, online(1))
        session = newest = bd_seq(host.until("NBIRTH"))
        for at_ms in range(2, 12):
            for state in (offline(at_ms), online(at_ms)):
                listener.client.publish(STATE, json.dumps(state), 1, retain=True)
            died = born = False  # its death may come as the broker's will, in any order with the next birth
            while not (died and born):
                heard = host.next()
                died |= heard.kind == "NDEATH" and bd_seq(heard) == session
                born |= heard.kind == "NBIRTH"
                newest = bd_seq(heard) if heard.kind == "NBIRTH" else newest
            session = newest


def test_of_several_brokers_the_node_uses_the_one_with_its_host(
    segment: Segment, make_broker: Callable[..., Mosquitto], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node moves to the next broker when the host has left the current one or is silent."""
    monkeypatch.setattr("shmio.endpoints.mqtt.sparkplug.session.HOST_S", 0.05)
    segment.writer("cell").publish(image(step=1), cycle=1)
    first, second = make_broker(), make_broker()
    with (
        listening(first.address, NODES) as at_first,
        listening(second.address, NODES) as at_second,
    ):
        say(at_second, online(5))
        with bridge(segment, [first.address, second.address], sparkplug=WAITING):
            assert Host(at_second).next().kind == "NBIRTH"
            say(at_first, online(1))
            say(at_second, offline(6))
            assert Host(at_first).next().kind == "NBIRTH"
