"""Commands that arrive from a real broker: values for a source's device, and the results of the writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from shmio.config import Mqtt, MqttTopic
from shmio.connectors.injection_layers import Owner
from shmio.endpoints.mqtt.bridge import Bridge
from shmio.endpoints.mqtt.connection.connection import FEW_IN_FLIGHT
from shmio.endpoints.mqtt.connection.socket_io import PACKETS
from shmio.model.values import WRITERS
from shmio.segment import Segment
from shmio.testing.mosquitto import Mosquitto
from shmio.testing.ports import reserved_port
from shmio.testing.proxy import FaultProxy
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.mqtt.harness import PREFIX, Listener, bridge, listening
from tests.unit.endpoints.plant import Plant


@contextmanager
def running(segment: Segment, broker: Mosquitto, **settings: Any) -> Iterator[tuple[Plant, Listener]]:
    """Run a device, a connected bridge and a client."""
    plant = Plant(segment.writer("cell"))
    plant.owners[WRITERS["mqtt"]] = Owner(WRITERS["mqtt"], 3)
    plant.run()
    try:
        with listening(broker.address) as listener, bridge(segment, broker.address, **settings):
            listener.until("cell/secret/out")
            yield plant, listener
    finally:
        plant.stop()


def test_a_value_reaches_the_device_and_its_result_is_published(segment: Segment, broker: Mosquitto) -> None:
    with running(segment, broker) as (_, listener):
        listener.publish("cell/axis/position/in", "2.5", CorrelationData=b"mine")
        listener.publish("cell/inputs/1/in", "7")
        listener.publish("cell/bits/3/in", "true")
        while True:
            message = listener.message()
            if message.topic == f"{PREFIX}/cell/axis/position/in/result":
                break
        assert json.loads(message.payload) == {"outcome": "written", "done": True, "reason": ""}
        assert vars(message.properties)["CorrelationData"] == b"mine"
        assert not message.retain
        listener.until("cell/bits/3/in/result")
        listener.shown("cell/bits/out", "[false,false,false,true,false,false,false,false,false,false]")
        listener.shown("cell/axis/position/out", "2.5")
        listener.shown("cell/inputs/out", "[0,7]")


def test_a_bit_and_a_slice_leave_their_neighbours_alone(segment: Segment, broker: Mosquitto) -> None:
    with running(segment, broker) as (plant, listener):
        listener.publish("cell/inputs/in", "[240, 255]")
        assert listener.json("cell/inputs/in/result")["done"]
        for topic, payload in (("inputs/0.%X1", "true"), ("inputs/1..1", "[9]"), ("bits/6..8", "[true, false, true]")):
            listener.publish(f"cell/{topic}/in", payload)
            assert listener.json(f"cell/{topic}/in/result") == {"outcome": "written", "done": True, "reason": ""}
        listener.shown("cell/inputs/out", "[242,9]")
        listener.shown("cell/bits/out", "[false,false,false,false,false,false,true,false,true,false]")
        assert [write.mask for write in plant.written[-3:]] == [0x40, 0x80, 0x01]


@pytest.mark.parametrize(
    ("topic", "payload", "reason"),
    [
        ("cell/axis/position/in", b"fast", "REAL: expected a number"),
        ("cell/axis/position/in", b"\xff\xfe", "not UTF-8"),
        ("cell/step/in", b"99999", "INT"),
        ("cell/secret/in", b"1", "not writable"),
        ("cell/secret/in", b"fast", "not writable"),
        ("cell/axis/nowhere/in", b"1", "no such register"),
        ("cell/axis/in", b"1", "a structure"),
        ("cell/inputs/9/in", b"1", "outside"),
        ("cell/inputs/0.%X8/in", b"1", "BYTE has bits 0 to 7"),
        ("cell/axis/speed/in", b"NaN", "NaN and infinities are written only if"),
        ("cell/%zz/in", b"1", "hexadecimal"),
        ("cell/bits/in", b"[" * 100_000, "JSON array"),
        ("cell/name/in", b"x" * 2_000_000, "longer than"),
    ],
)
def test_failed_commands_have_a_result_and_the_bridge_continues(
    segment: Segment,
    broker: Mosquitto,
    topic: str,
    payload: bytes,
    reason: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with running(segment, broker) as (plant, listener):
        listener.publish(topic, payload)
        told = listener.json(f"{topic}/result")
        assert (told["outcome"], told["done"]) == ("rejected", False)
        assert reason in told["reason"]
        assert f"the command on {PREFIX}/{topic} was not carried out: rejected: {told['reason']}" in caplog.messages
        assert not plant.written
        listener.publish("cell/step/in", "5")
        assert listener.json("cell/step/in/result")["done"]


def test_a_topic_too_long_for_its_result_is_ignored(segment: Segment, broker: Mosquitto) -> None:
    with running(segment, broker) as (plant, listener):
        longest = 65535 - len(f"{PREFIX}/cell//in")
        listener.publish(f"cell/{'x' * longest}/in", "1")
        shorter = f"cell/{'x' * (longest - len('/result'))}/in"
        listener.publish(shorter, "1")
        assert "a path is at most" in listener.json(f"{shorter}/result")["reason"]
        assert not plant.written


def test_a_refusal_by_the_device_is_a_result(segment: Segment, broker: Mosquitto) -> None:
    with running(segment, broker) as (plant, listener):
        plant.refusal = "access denied"
        listener.publish("cell/step/in", "5")
        assert listener.json("cell/step/in/result") == {
            "outcome": "refused", "done": False, "reason": "access denied",
        }  # fmt: skip


def test_a_retained_command_is_not_carried_out(segment: Segment, broker: Mosquitto) -> None:
    """The age of a retained command is unknown. A sender that is still there can publish it again."""
    with listening(broker.address, "none") as before:
        before.publish("cell/step/in", "5", retain=True)
    with running(segment, broker) as (plant, listener):
        listener.publish("cell/axis/speed/in", "1.5")
        listener.until("cell/axis/speed/in/result")
        assert len(plant.written) == 1
        listener.publish("cell/step/in", "6", retain=True)
        told = listener.json("cell/step/in/result")
        assert (told["outcome"], "publish commands without the retain flag" in told["reason"]) == ("rejected", True)
        assert len(plant.written) == 1


def test_a_retained_command_of_a_bridged_broker_is_not_carried_out(
    segment: Segment, make_broker: Callable[..., Mosquitto], tmp_path: Path
) -> None:
    """A second broker is bridged to the instance's broker.

    Whenever their connection is restored, the second broker sends its retained messages as new ones.
    """
    (tmp_path / "elsewhere").mkdir()
    with reserved_port() as address:
        elsewhere = Mosquitto(tmp_path / "elsewhere", address)
        elsewhere.start()
        try:
            with listening(address, "none") as before, FaultProxy(address, framing=None) as proxy:
                before.publish("cell/step/in", "5", retain=True)
                proxy.refuse()
                join = ("connection plant", f"address {proxy.address}", f"topic {PREFIX}/# both 1", "restart_timeout 1")
                with running(segment, make_broker("allow_anonymous true", *join)) as (plant, listener):
                    proxy.admit()
                    assert listener.json("cell/step/in/result")["outcome"] == "rejected"
                    before.publish("cell/axis/speed/in", "1.5")
                    assert listener.json("cell/axis/speed/in/result")["done"]
                    assert len(plant.written) == 1
        finally:
            elsewhere.stop()


def test_results_go_to_the_clients_response_topic_below_the_prefix(segment: Segment, broker: Mosquitto) -> None:
    with running(segment, broker) as (_, listener):
        listener.publish("cell/step/in", "5", ResponseTopic=f"{PREFIX}/shmio/results/me")
        assert listener.json("shmio/results/me")["done"]
        for elsewhere in ("cell/step/in", f"{PREFIX}/cell/axis/speed/in", "$SYS/x", f"{PREFIX}/shmio/results/+"):
            if "+" not in elsewhere:
                listener.publish("cell/step/in", "5", ResponseTopic=elsewhere)
                assert listener.json("cell/step/in/result")["done"]
        listener.publish("cell/step/in", "6")
        listener.until("cell/step/in/result")
    assert not [topic for topic, payload in listener.heard if b"outcome" in payload and not topic.endswith(
        ("cell/step/in/result", "shmio/results/me"))]  # fmt: skip


def test_a_json_register_accepts_a_value_or_an_object_with_one(segment: Segment, broker: Mosquitto) -> None:
    rules = [MqttTopic(match="cell", payload="json")]
    with running(segment, broker, topic=rules) as (_, listener):
        for payload in ('{"value": 2.5, "quality": "good"}', "3.5", '{"value": "NaN"}'):
            listener.publish("cell/axis/position/in", payload)
            assert listener.json("cell/axis/position/in/result")["done"]
        listener.publish("cell/name/in", '{"value": "hi"}')
        assert listener.json("cell/name/in/result")["done"]
        listener.publish("cell/bits/in", json.dumps({"value": [True] * 10}))
        assert listener.json("cell/bits/in/result")["done"]
        for payload in ('{"worth": 1}', "{", "[" * 10_000):
            listener.publish("cell/axis/position/in", payload)
            assert "as JSON" in listener.json("cell/axis/position/in/result")["reason"]


def test_a_flood_of_commands_is_bounded_and_answered(segment: Segment, make_broker: Callable[..., Mosquitto]) -> None:
    """By default, mosquitto queues 1000 messages for a slow client, and drops later ones, such as the last result."""
    with running(segment, make_broker("allow_anonymous true", "max_queued_messages 0")) as (_, listener):
        for number in range(5000):
            listener.client.publish(f"{PREFIX}/cell/step/in", str(number % 1000), 0)
        listener.publish("cell/axis/speed/in", "1.5")
        listener.until("cell/axis/speed/in/result")
        listener.publish("cell/axis/speed/in", "2.5")
        assert listener.json("cell/axis/speed/in/result")["done"]


@pytest.mark.parametrize(("qos", "bound"), [(0, PACKETS), (1, PACKETS + FEW_IN_FLIGHT)])
def test_commands_are_taken_a_few_at_a_time(
    segment: Segment, make_broker: Callable[..., Mosquitto], qos: int, bound: int
) -> None:
    """The limit also holds while results wait for acknowledgements.

    Otherwise many commands would delay all other work.
    """
    broker = make_broker("allow_anonymous true", "max_inflight_messages 1000", "max_queued_messages 0")
    writer, slot = segment.writer("cell"), segment.processes.find("mqtt")
    writer.publish(image(), cycle=1)
    assert slot.take()
    bridge = Bridge(segment, slot, Mqtt(broker="external", host=str(broker.address), prefix=PREFIX))
    try:
        while not bridge.connection.up or bridge.outbox.busy or bridge.connection.in_flight:
            bridge.run_once()
        with listening(broker.address, "none") as flooder:
            for _ in range(1000):
                flooder.client.publish(f"{PREFIX}/cell/nowhere/in", "1", qos)
            flooder.publish("cell/nowhere/in", "1")
        most = 0
        while (before := bridge.counters[1]) < 1001:
            bridge.run_once()
            most = max(most, bridge.counters[1] - before)
        assert most <= bound
    finally:
        bridge.close()
