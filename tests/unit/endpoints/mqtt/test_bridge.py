"""What the bridge publishes to a real broker."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable

import msgspec
import pytest

from shmio.config import Mqtt, MqttTopic, Sparkplug
from shmio.endpoints.mqtt.bridge import Bridge
from shmio.segment import BlockWriter, ProcessSpec, Provenance, Quality, Segment
from shmio.segment.injection_list import InjectionEntry, encode
from shmio.testing.mosquitto import Mosquitto
from tests.unit.endpoints.harness import LAYOUT, image
from tests.unit.endpoints.mqtt.harness import PREFIX, Listener, bridge, listening

OUT = f"{PREFIX}/+/#"


def test_only_changes_are_published(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(position=1.5, step=7), cycle=1)
    with listening(broker.address) as listener:
        with bridge(segment, broker.address):
            assert listener.until("status") == b"online"
            assert listener.until("cell/secret/out") == b"0"  # the last topic of the first round
            writer.publish(image(position=2.5, step=7), cycle=2)
            writer.publish(image(position=2.5, step=8, inputs=b"\1\2"), cycle=3)
            assert listener.until("cell/step/out") == b"8"
        listener.until("status", b"offline")
    assert listener.values("cell/axis/position/out") == ["1.5", "2.5"]
    assert listener.values("cell/inputs/out") == ["[0,0]", "[1,2]"]
    assert listener.values("cell/running/out") == ["false"]


def test_a_later_subscriber_gets_the_current_values(segment: Segment, broker: Mosquitto) -> None:
    segment.writer("cell").publish(image(position=1.5), cycle=1)
    with listening(broker.address) as first, bridge(segment, broker.address):
        first.until("cell/secret/out")
        with listening(broker.address) as listener:
            assert listener.until("cell/axis/position/out") == b"1.5"
            assert listener.heard


def test_bad_quality_is_published_on_each_topic(segment: Segment, broker: Mosquitto) -> None:
    """The text topic is emptied, also for later subscribers; the JSON value is marked as bad."""
    rules = [MqttTopic(match="cell/step", payload="json")]
    writer = segment.writer("cell")
    writer.publish(image(position=1.5, step=3), cycle=1)
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules):
        good = listener.json("cell/status")
        assert (good["quality"], good["provenance"], good["cycle"]) == ("good", "live", 1)
        assert listener.until("cell/axis/position/out") == b"1.5"
        value = listener.json("cell/step/out")
        assert (value["value"], value["quality"], value["provenance"]) == (3, "good", "live")
        writer.publish(image(position=1.5, step=3), cycle=2, quality=Quality.BAD, reason="cable out")
        assert listener.json("cell/status") == {**good, "quality": "bad", "reason": "cable out", "cycle": 2} | {
            "source_time": pytest.approx(good["source_time"], abs=60)
        }
        assert listener.until("cell/axis/position/out") == b""
        bad = listener.json("cell/step/out")
        assert (bad["value"], bad["quality"], bad["reason"]) == (3, "bad", "cable out")
        listener.until("cell/secret/out")
        with listening(broker.address, f"{PREFIX}/cell/axis/#", f"{PREFIX}/cell/status") as later:
            assert later.message().topic == f"{PREFIX}/cell/status"  # the text topic is empty
        writer.publish(image(position=1.5, step=3), cycle=3)
        assert listener.until("cell/axis/position/out") == b"1.5"
        assert listener.json("cell/step/out")["quality"] == "good"


def test_a_source_without_new_frames_turns_bad(soon_stale: Segment, broker: Mosquitto) -> None:
    soon_stale.processes.add(ProcessSpec("mqtt", "mqtt"))
    writer = soon_stale.writer("cell")
    writer.publish(image(position=1.5), cycle=1)
    with listening(broker.address) as listener, bridge(soon_stale, broker.address):
        while (told := listener.json("cell/status"))["quality"] != "bad":
            pass
        assert told["reason"].startswith("stale")
        assert listener.until("cell/axis/position/out", b"") == b""


def test_uncertain_values_are_published_and_marked(segment: Segment, broker: Mosquitto) -> None:
    rules = [MqttTopic(match="cell/step", payload="json")]
    writer = segment.writer("cell")
    writer.publish(image(position=1.5), cycle=1)
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules):
        listener.until("cell/secret/out")
        writer.publish(image(position=2.5), cycle=2, quality=Quality.UNCERTAIN, reason="PLC in STOP")
        assert listener.json("cell/status")["reason"] == "PLC in STOP"
        assert listener.json("cell/step/out")["quality"] == "uncertain"
        assert listener.until("cell/axis/position/out") == b"2.5"


def test_injected_values_are_published(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(position=1.5), cycle=1)
    with listening(broker.address) as listener, bridge(segment, broker.address):
        listener.until("cell/secret/out")
        writer.publish(image(position=1.5), cycle=2, effective=image(position=9.5), provenance=Provenance.LIVE)
        assert listener.until("cell/axis/position/out") == b"9.5"


def test_json_marks_injected_registers_even_with_an_equal_value(segment: Segment, broker: Mosquitto) -> None:
    cell, writer, data = segment.blocks["cell"], segment.writer("cell"), image(position=1.5, step=7)

    def stand(*places: tuple[int, int]) -> None:
        ones = [
            InjectionEntry(number, "out", 0, keep=False, name="", writer=0, pid=1, ranges=((at, size, 255),))
            for number, (at, size) in enumerate(places)
        ]
        cell.injections.write(encode(map(msgspec.json.encode, ones)))

    position, step = (0, 4), (12, 2)
    writer.publish(data, cycle=1)
    rules = [MqttTopic(match="**", payload="json")]
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules):
        listener.until("cell/secret/out")
        stand(position)
        writer.publish(data, cycle=2, effective=data)
        assert listener.json("cell/axis/position/out")["provenance"] == "injected"
        stand(position, step)
        writer.publish(data, cycle=3, effective=data)
        assert listener.json("cell/step/out")["provenance"] == "injected"
        stand(step)
        writer.publish(data, cycle=4, effective=data)
        assert listener.json("cell/axis/position/out")["provenance"] == "live"
        stand()
        writer.publish(data, cycle=5)
        assert listener.json("cell/step/out")["provenance"] == "live"
    assert len(listener.values("cell/axis/position/out")) == 3
    assert len(listener.values("cell/axis/speed/out")) == 1


def test_rules_choose_what_is_published_and_how(segment: Segment, broker: Mosquitto) -> None:
    rules = [
        MqttTopic(match="cell/axis/speed", publish=False),
        MqttTopic(match="cell/inputs", elements=True),
        MqttTopic(match=["cell/name", "cell/step"], retain=False, qos=0),
        MqttTopic(match="cell", payload="frames"),
    ]
    writer = segment.writer("cell")
    writer.publish(image(position=1.5, inputs=b"\3\4"), cycle=1)
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules):
        frame = listener.until("cell/frames")
        assert struct.unpack_from(">f", frame)[0] == 1.5
        assert len(frame) == LAYOUT.size
        topics = {topic for topic, _ in listener.heard}
        assert f"{PREFIX}/cell/axis/speed/out" not in topics
        assert f"{PREFIX}/cell/inputs/out" not in topics
        assert listener.values("cell/inputs/0/out") == ["3"]
        assert listener.values("cell/inputs/1/out") == ["4"]
        with listening(broker.address) as later:
            later.until("cell/status")
            assert not later.values("cell/step/out")


def test_bits_and_slices_have_topics_where_a_rule_names_them(segment: Segment, broker: Mosquitto) -> None:
    rules = [
        MqttTopic(match="cell/inputs/1.%X2"),
        MqttTopic(match=["cell/inputs/0..1", "cell/inputs/0.%X9"], retain=False),
    ]
    writer = segment.writer("cell")
    writer.publish(image(inputs=b"\3\4"), cycle=1)
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules):
        assert listener.until("cell/inputs/1.%X2/out") == b"true"
        writer.publish(image(inputs=b"\3\5"), cycle=2)  # a neighbouring bit
        writer.publish(image(inputs=b"\3\1"), cycle=3)
        assert listener.until("cell/inputs/1.%X2/out") == b"false"
        assert json.loads(listener.until("cell/inputs/0..1/out", b"[3,1]")) == [3, 1]
        assert f"{PREFIX}/cell/inputs/0.%X9/out" not in {topic for topic, _ in listener.heard}
    assert listener.values("cell/inputs/1.%X2/out") == ["true", "false"]


def wait_for(listener: Listener, topic: str, count: int) -> list[str]:
    while len(values := listener.values(topic)) < count:
        listener.message()
    return values


def test_changes_within_the_dead_band_are_not_published(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(position=1.0), cycle=1)
    rules = [MqttTopic(match="cell/axis/position", deadband=0.5)]
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules):
        listener.until("cell/secret/out")
        for cycle, position in enumerate((1.25, 1.25, 1.5, 1.75, 1.0), 2):
            writer.publish(image(position=position, step=cycle), cycle=cycle)
            listener.until("cell/step/out", str(cycle).encode())
    assert listener.values("cell/axis/position/out") == ["1.0", "1.5", "1.0"]


def test_a_rate_limit_skips_values_but_never_the_last(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    writer.publish(image(position=0.0), cycle=1)
    rules = [MqttTopic(match="cell/axis/position", max_rate_hz=5)]
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules):
        listener.until("cell/secret/out")
        begun_s = time.monotonic()
        for cycle in range(2, 102):
            writer.publish(image(position=cycle, step=cycle), cycle=cycle)
            listener.until("cell/step/out")
        assert listener.until("cell/axis/position/out", b"101.0")
        passed_s = time.monotonic() - begun_s
    assert len(listener.values("cell/axis/position/out")) <= 2 + passed_s * 5


def test_a_structure_is_one_message_for_each_frame_that_changes_it(segment: Segment, broker: Mosquitto) -> None:
    """The message has all members that no earlier rule matches.

    If a rule names a register itself, the register has its own message.
    """
    rules = [
        MqttTopic(match="cell/long", publish=False),
        MqttTopic(match=["cell/axis", "cell/step"], payload="structure"),
        MqttTopic(match="cell", payload="structure"),
    ]
    writer = segment.writer("cell")
    writer.publish(image(position=1.5, speed=float("nan"), step=7, inputs=b"\3\4"), cycle=1)
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules) as running:
        axis = listener.json("cell/axis/out")
        assert (axis["value"], axis["quality"]) == ({"position": 1.5, "speed": "NaN"}, "good")
        rest = listener.json("cell/out")["value"]
        assert set(rest) == {"running", "inputs", "bits", "name", "secret"}
        assert (rest["inputs"], rest["running"]) == ([3, 4], False)
        writer.publish(image(position=2.5, speed=3.5, step=8, inputs=b"\3\4"), cycle=2)
        assert listener.json("cell/axis/out")["value"] == {"position": 2.5, "speed": 3.5}
        assert listener.json("cell/step/out")["value"] == 8
        writer.publish(
            image(position=2.5, speed=3.5, step=8, inputs=b"\3\4"), cycle=3, quality=Quality.BAD, reason="out"
        )
        bad = listener.json("cell/axis/out")
        assert (bad["value"], bad["quality"], bad["reason"]) == ({"position": 2.5, "speed": 3.5}, "bad", "out")
        assert listener.json("cell/out")["quality"] == "bad"
        running.until(lambda: not running.bridge.outbox.busy)
    assert len(listener.values("cell/axis/out")) == 3
    assert {topic for topic, _ in listener.heard if topic.startswith(f"{PREFIX}/cell/")} == {
        f"{PREFIX}/cell/{topic}" for topic in ("status", "axis/out", "step/out", "out")
    }


def test_texts_and_values_without_a_json_form(segment: Segment, broker: Mosquitto) -> None:
    """A STRING is sent as its text, and an array as JSON. NaN is the text "NaN" in JSON."""
    rules = [MqttTopic(match="cell/axis", payload="json")]
    data = bytearray(image(position=float("nan"), running=True))
    data[16:20] = bytes([8, 2]) + b"hi"
    segment.writer("cell").publish(bytes(data), cycle=1)
    with listening(broker.address) as listener, bridge(segment, broker.address, topic=rules):
        listener.until("cell/secret/out")
    assert json.loads(listener.values("cell/axis/position/out")[0])["value"] == "NaN"
    assert listener.values("cell/name/out") == ["hi"]
    assert listener.values("cell/running/out") == ["true"]


def burst(writer: BlockWriter, cycles: range) -> None:
    for cycle in cycles:
        writer.publish(image(position=cycle, step=cycle), cycle=cycle)


def test_a_burst_of_frames_ends_with_the_last_value(segment: Segment, broker: Mosquitto) -> None:
    writer = segment.writer("cell")
    burst(writer, range(1, 3))
    with listening(broker.address) as listener, bridge(segment, broker.address):
        listener.until("cell/secret/out")
        burst(writer, range(3, 3000))
        listener.until("cell/step/out", b"2999")
        steps = [int(value) for value in listener.values("cell/step/out")]
    assert steps == sorted(set(steps))


@pytest.mark.parametrize("sparkplug", [None, Sparkplug(group="plant")])
def test_frames_that_the_bridge_missed_are_counted_and_reported(
    segment: Segment,
    make_broker: Callable[..., Mosquitto],
    sparkplug: Sparkplug | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("shmio.endpoints.mqtt.feed.CATCH_UP_S", 48 * segment.blocks["cell"].period_ns / 1e9)
    broker = make_broker("allow_anonymous true", "max_inflight_messages 10000")
    writer, slot = segment.writer("cell"), segment.processes.find("mqtt")
    burst(writer, range(1, 3))
    assert slot.take()
    settings = Mqtt(broker="external", host=str(broker.address), prefix=PREFIX, sparkplug=sparkplug)
    bridge = Bridge(segment, slot, settings)
    followers = 1 if sparkplug is None else 2
    try:
        with listening(broker.address, f"{PREFIX}/#") as listener:
            while bridge.counters[6] < followers or bridge.outbox.busy:
                bridge.run_once()
            assert listener.json("cell/status")["missed"] == 0
            burst(writer, range(3, 52))
            while listener.values("cell/step/out")[-1:] != ["51"]:
                bridge.run_once()
                listener.taken()
            assert bridge.counters[7] == 48 * followers
            burst(writer, range(52, 100))
            while listener.values("cell/step/out")[-1:] != ["99"]:
                bridge.run_once()
                listener.taken()
            assert bridge.counters[7] == 48 * followers
    finally:
        bridge.close()
    steps = [int(value) for value in listener.values("cell/step/out")]
    assert steps == [2, 51, *range(52, 100)]
    told = [json.loads(payload)["missed"] for topic, payload in listener.heard if topic == f"{PREFIX}/cell/status"]
    assert told[:2] == [0, 48]
