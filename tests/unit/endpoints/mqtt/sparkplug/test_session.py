"""An instance as an edge node at a real broker, with a host application."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest

from shmio.backoff import Backoff
from shmio.config import Address, Mqtt, MqttTopic, Sparkplug
from shmio.connectors.injection_layers import Owner
from shmio.endpoints.mqtt.bridge import Bridge
from shmio.model.values import WRITERS
from shmio.segment import Quality, Segment
from shmio.testing.mosquitto import Mosquitto
from shmio.testing.proxy import FaultProxy
from shmio.wire import sparkplug_b_pb2 as wire
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.mqtt.harness import TIMEOUT_S, Listener, Running, bridge
from tests.unit.endpoints.plant import Plant

NODE = "spBv1.0/plant/{}/a50"
PLANT = Sparkplug(group="plant", node="a50")


class Heard(NamedTuple):
    """A received message: its type (NBIRTH, DDATA and so on), and its metrics by name."""

    kind: str
    payload: wire.Payload
    metrics: dict[str, wire.Metric]


class Host:
    """A host application, which learns the metrics' aliases from the births that it receives."""

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self._names: dict[int, str] = {}
        self.seqs: list[int] = []

    def next(self) -> Heard:
        """Return the node's next message."""
        message = self._listener.message()
        while message.topic.split("/")[1] == "STATE" or message.topic.split("/")[2] in (
            "NCMD",
            "DCMD",
        ):  # sent by this host
            message = self._listener.message()
        assert not message.retain
        kind = message.topic.split("/")[2]
        payload = wire.Payload.FromString(bytes(message.payload))
        assert payload.HasField("seq") == (kind != "NDEATH")
        if kind == "NBIRTH":
            self._names, self.seqs = {}, []
        if kind in ("NBIRTH", "DBIRTH"):
            self._names |= {metric.alias: metric.name for metric in payload.metrics if metric.HasField("alias")}
        if kind != "NDEATH":
            self.seqs.append(payload.seq)
            assert self.seqs == [number % 256 for number in range(len(self.seqs))]
        return Heard(kind, payload, {one.name or self._names[one.alias]: one for one in payload.metrics})

    def until(self, kind: str) -> Heard:
        """Return the next message of a kind."""
        while (found := self.next()).kind != kind:
            pass
        return found

    def command(self, kind: str, *metrics: wire.Metric, device: str = "") -> None:
        """Send an NCMD or DCMD with these metrics."""
        topic = NODE.format(kind) + (f"/{device}" if device else "")
        self.send(topic, wire.Payload(timestamp=1, metrics=metrics).SerializeToString())

    def send(self, topic: str, data: bytes, *, retain: bool = False) -> None:
        """Send any payload on any topic."""
        self._listener.client.publish(topic, data, 0, retain).wait_for_publish(30)


@contextmanager
def hosting(address: Address) -> Iterator[Host]:
    listener = Listener(address, "spBv1.0/#")
    try:
        yield Host(listener)
    finally:
        listener.close()


@contextmanager
def node(segment: Segment, address: Address, **settings: Any) -> Iterator[Running]:
    with bridge(segment, address, **({"sparkplug": PLANT} | settings)) as running:
        yield running


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.connection.reconnect.RECONNECT", Backoff(0.02, 0.1))


def bd_seq(heard: Heard) -> int:
    return heard.metrics["bdSeq"].long_value


def test_a_node_sends_birth_changes_and_death(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(position=1.5, step=7), cycle=1)
    with hosting(broker.address) as host:
        with node(segment, broker.address):
            birth = host.next()
            assert birth.kind == "NBIRTH"
            device = host.next()
            assert device.kind == "DBIRTH"
            assert device.metrics["axis/position"].float_value == 1.5
            assert device.metrics["step"].int_value == 7
            assert not device.metrics["step"].HasField("properties")
            writer.publish(image(position=2.5, step=7), cycle=2)
            data = host.next()
            assert (data.kind, set(data.metrics)) == ("DDATA", {"axis/position"})
            assert data.metrics["axis/position"].float_value == 2.5
            assert not data.metrics["axis/position"].HasField("name")
            assert not data.metrics["axis/position"].is_historical
        death = host.until("NDEATH")
        assert bd_seq(death) == bd_seq(birth)


def test_an_orderly_end_sends_the_death_and_with_mqtt_5_the_will(segment: Segment, broker: Mosquitto) -> None:
    """Sparkplug 3.0.0 requires both messages (5.5, 6.4.25).

    They have the same bdSeq, so hosts ignore the second one.
    """
    segment.writer("cell").publish(image(), cycle=1)
    with hosting(broker.address) as host:
        with node(segment, broker.address):
            session = bd_seq(host.until("NBIRTH"))
        deaths = []
        with node(segment, broker.address):
            while (heard := host.next()).kind != "NBIRTH":
                if heard.kind == "NDEATH":
                    deaths.append(bd_seq(heard))
        assert deaths == [session, session]


def test_a_bad_source_is_a_dead_device(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(), cycle=1, quality=Quality.BAD, reason="cable out")
    with hosting(broker.address) as host, node(segment, broker.address):
        assert host.next().kind == "NBIRTH"
        writer.publish(image(position=1.5), cycle=2)
        assert host.next().kind == "DBIRTH"
        writer.publish(image(position=1.5), cycle=3, quality=Quality.UNCERTAIN, reason="PLC in STOP")
        doubtful = host.next().metrics["axis/position"].properties
        assert [doubtful.values[0].int_value, doubtful.values[1].string_value] == [500, "PLC in STOP"]
        writer.publish(image(position=1.5), cycle=4, quality=Quality.BAD, reason="cable out")
        assert host.next().kind == "DDEATH"
        writer.publish(image(position=2.5), cycle=5)
        again = host.next()
        assert (again.kind, again.metrics["axis/position"].float_value) == ("DBIRTH", 2.5)


def test_a_node_sends_a_new_birth_on_request(segment: Segment, broker: Mosquitto) -> None:
    segment.writer("cell").publish(image(position=1.5), cycle=1)
    with hosting(broker.address) as host, node(segment, broker.address):
        first = host.next()
        host.until("DBIRTH")
        host.command("NCMD", wire.Metric(name="Node Control/Rebirth", boolean_value=True))
        again = host.next()
        assert (again.kind, bd_seq(again)) == ("NBIRTH", bd_seq(first))
        assert host.next().kind == "DBIRTH"


def test_commands_reach_the_device_and_garbage_is_ignored(segment: Segment, broker: Mosquitto) -> None:
    plant = Plant(segment.writer("cell"))
    plant.owners[WRITERS["mqtt"]] = Owner(WRITERS["mqtt"], 3)
    plant.run()
    try:
        with hosting(broker.address) as host, node(segment, broker.address) as running:
            alias = host.until("DBIRTH").metrics["axis/position"].alias
            for metric in (
                wire.Metric(name="axis/nowhere", float_value=1),
                wire.Metric(name="secret", int_value=1),
                wire.Metric(name="axis/position", string_value="fast"),
                wire.Metric(alias=alias, float_value=2.5),
            ):
                host.command("DCMD", metric, device="cell")
            while (changed := host.until("DDATA").metrics.get("axis/position")) is None:
                pass
            assert changed.float_value == 2.5
            running.until(lambda: running.bridge.counters[1:3] == (4, 3))
    finally:
        plant.stop()


def test_one_element_of_an_array_is_written_and_garbage_is_ignored(segment: Segment, broker: Mosquitto) -> None:
    plant = Plant(segment.writer("cell"))
    plant.owners[WRITERS["mqtt"]] = Owner(WRITERS["mqtt"], 3)
    plant.run()
    elements = Sparkplug(group="plant", node="a50", elements=True, primary_host="scada")
    try:
        with hosting(broker.address) as host, node(segment, broker.address, sparkplug=elements) as running:
            online = b'{"online":true,"timestamp":1}'
            host.send("spBv1.0/STATE/scada", online, retain=True)
            alias = host.until("DBIRTH").metrics["inputs/1"].alias
            for state in (
                b"",
                b"\xff",
                b"[" * 100_000,
                b'{"online":1,"timestamp":2}',
                b'{"online":true,"timestamp":1e999}',
            ):
                host.send("spBv1.0/STATE/scada", state)
            for data in (b"", b"\xff" * 1000, b"\x12\x00" * 5000, b"\x00" * (1 << 20), b"\x12\x84\x80\x80\x80\x08"):
                for kind in ("NCMD", "DCMD"):
                    host.send(NODE.format(kind) + "/cell" * (kind == "DCMD"), data)
            host.send(NODE.format("DCMD") + "/" + "x" * 60_000, b"")
            host.command("DCMD", wire.Metric(name="inputs/1", int_value=300), device="cell")
            host.command("DCMD", wire.Metric(name="", alias=alias, int_value=7), device="cell")
            while (changed := host.until("DDATA").metrics.get("inputs/1")) is None:
                pass
            assert (changed.int_value, changed.datatype) == (7, 5)
            running.until(lambda: running.bridge.counters[1:3] == (13, 12))
            assert running.bridge.problem == ""
    finally:
        plant.stop()


def test_changes_while_the_broker_is_away_are_sent_as_historical(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(step=1), cycle=1)
    with (
        FaultProxy(broker.address, framing=None) as proxy,
        hosting(broker.address) as host,
        node(segment, proxy.address) as running,
    ):
        first = host.until("NBIRTH")
        host.until("DBIRTH")
        proxy.refuse()
        assert bd_seq(host.until("NDEATH")) == bd_seq(first), "the broker sends the last will"
        running.until(lambda: "Sparkplug" in running.bridge.problem or "nothing listens" in running.bridge.problem)
        for step in range(2, 12):
            writer.publish(image(step=step), cycle=step)
        running.until(lambda: running.bridge.counters[4] >= 20)  # changes count once as topics and once as metrics
        proxy.admit()
        again = host.until("NBIRTH")
        assert bd_seq(again) == (bd_seq(first) + 1) % 256, "failed attempts do not count"
        assert host.next().metrics["step"].int_value == 11
        told = [host.next() for _ in range(10)]
        assert [one.metrics["step"].int_value for one in told] == list(range(2, 12))
        assert all(one.metrics["step"].is_historical for one in told)
        times_ms = [one.metrics["step"].timestamp for one in told]
        assert times_ms == sorted(times_ms)


def test_a_rate_limit_conflates_changes_even_without_the_broker_and_sends_the_last(
    segment: Segment, broker: Mosquitto
) -> None:
    writer = segment.writer("cell")
    writer.publish(image(step=1), cycle=1)
    slowly = Sparkplug(group="plant", node="a50", max_rate_hz=2)
    with (
        FaultProxy(broker.address, framing=None) as proxy,
        hosting(broker.address) as host,
        node(segment, proxy.address, sparkplug=slowly) as running,
    ):
        host.until("DBIRTH")
        begun_s = time.monotonic()
        for step in range(2, 52):
            writer.publish(image(step=step), cycle=step)
        told: list[int] = []
        while told[-1:] != [51]:
            told.append(host.until("DDATA").metrics["step"].int_value)
        assert len(told) <= 2 + 2 * (time.monotonic() - begun_s)
        proxy.refuse()
        host.until("NDEATH")
        running.until(lambda: "Sparkplug" in running.bridge.problem or "nothing listens" in running.bridge.problem)
        dropped = running.bridge.outbox.backlog
        for step in range(52, 102):
            writer.publish(image(step=step), cycle=step)
        running.until(lambda: running.bridge.outbox.backlog >= dropped + 50)
        assert running.bridge.counters[4] - running.bridge.outbox.backlog < 25
        proxy.admit()
        assert host.until("DBIRTH").metrics["step"].int_value == 101


def test_a_flood_of_rebirth_requests_is_answered_by_few_births(segment: Segment, broker: Mosquitto) -> None:
    """A birth may have megabytes, and a client can request births without reading them."""
    segment.writer("cell").publish(image(step=1), cycle=1)
    with FaultProxy(broker.address, framing=None) as proxy, hosting(broker.address) as host:
        with node(segment, proxy.address):
            host.until("DBIRTH")
            proxy.freeze()
            for _ in range(100):
                host.command("NCMD", wire.Metric(name="Node Control/Rebirth", boolean_value=True))
            proxy.thaw()
            host.until("DBIRTH")
        births = 1
        while (kind := host.next().kind) != "NDEATH":
            births += kind == "NBIRTH"
    assert births < 50


def test_the_backlog_is_sent_in_small_portions(
    segment: Segment, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a large backlog would delay commands and the heartbeat."""
    monkeypatch.setattr("shmio.endpoints.mqtt.sparkplug.session.TURN_SAMPLES", 2)
    writer, slot = segment.writer("cell"), segment.processes.find("mqtt")
    writer.publish(image(step=1), cycle=1)
    nothing = [MqttTopic(match="**", publish=False)]
    assert slot.take()
    bridge = Bridge(segment, slot, Mqtt(broker="external", host=str(broker.address), topic=nothing, sparkplug=PLANT))

    def run_until(until: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + TIMEOUT_S
        while not until():
            bridge.run_once()
            assert time.monotonic() < deadline_s

    def kept() -> int:
        return bridge.counters[4]

    try:
        run_until(lambda: bridge.counters[6] == 2)
        broker.kill()
        run_until(lambda: bool(bridge.problem))
        for step in range(2, 42):
            writer.publish(image(step=step), cycle=step)
        run_until(lambda: kept() >= 40)
        broker.start()
        before, most = kept(), 0

        def less() -> bool:
            nonlocal before, most
            most, before = max(most, before - kept()), kept()
            return not before

        run_until(less)
        assert most <= 2
        assert bridge.counters[5] == 0
    finally:
        bridge.close()
