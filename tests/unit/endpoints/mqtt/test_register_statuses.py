"""What MQTT clients see of a source that gives each register a status."""

from __future__ import annotations

import json

from shmio.config import MqttTopic
from shmio.connectors.register_image import RegisterImage
from shmio.endpoints.mqtt.commands import CommandClient
from shmio.endpoints.mqtt.feed import follow
from shmio.endpoints.mqtt.sparkplug.device import Device, DeviceEvent
from shmio.endpoints.mqtt.sparkplug.node import Metric
from shmio.endpoints.mqtt.topics import RegisterChannel, StructureChannel
from shmio.layout.glob import Glob
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN, UNCERTAIN_LAST_USABLE_VALUE
from shmio.model.values import Quality
from tests.unit.statuses import COUNT, LAYOUT, SOURCE_NS, SPEED, first_image, plant

UNKNOWN = "the device reports BadNodeIdUnknown (0x80340000)"


def test_a_bad_register_is_an_empty_text_and_json_with_its_reason(instance: str) -> None:
    with plant(instance) as (segment, writer):
        follower = follow(segment.blocks["plant"])
        rule = MqttTopic("**")
        speed, count = LAYOUT.registers[SPEED], LAYOUT.registers[COUNT]
        text, other = (RegisterChannel(follower, one, one.path, rule) for one in (speed, count))
        objects = RegisterChannel(follower, speed, "speed", MqttTopic("**", payload="json"))
        image = first_image()
        image.fail(SPEED, BAD_NODE_ID_UNKNOWN, SOURCE_NS + 5 * 10**9)
        writer.publish(bytes(image), cycle=1)
        frame = follower.newest()
        assert frame is not None
        follower.take(frame)
        assert (text.message().payload, other.message().payload) == (b"", b"1")
        found = json.loads(objects.message().payload)
        assert (found["value"], found["quality"], found["reason"]) == (1.5, "bad", UNKNOWN)
        assert found["source_time"] == SOURCE_NS / 1e9 + 5


def test_json_of_a_register_without_a_value_yet_is_null(instance: str) -> None:
    with plant(instance) as (segment, writer):
        follower = follow(segment.blocks["plant"])
        channel = RegisterChannel(follower, LAYOUT.registers[COUNT], "count", MqttTopic("**", payload="json"))
        writer.publish(bytes(RegisterImage(LAYOUT)), cycle=1)
        frame = follower.newest()
        assert frame is not None
        follower.take(frame)
        found = json.loads(channel.message().payload)
        assert (found["value"], found["quality"], found["source_time"]) == (None, "bad", None)
        assert "no data yet" in found["reason"]


def test_a_structure_has_the_quality_of_its_worst_register(instance: str) -> None:
    with plant(instance) as (segment, writer):
        follower = follow(segment.blocks["plant"])
        channel = StructureChannel(follower, "", LAYOUT.registers, "out", MqttTopic("**", payload="structure"))
        image = first_image()
        for code, expected in (
            (UNCERTAIN_LAST_USABLE_VALUE, ("uncertain", "the device reports UncertainLastUsableValue (0x40900000)")),
            (BAD_NODE_ID_UNKNOWN, ("bad", UNKNOWN)),
        ):
            image.fail(SPEED, code)
            writer.publish(bytes(image), cycle=1)
            frame = follower.newest()
            assert frame is not None
            follower.take(frame)
            found = json.loads(channel.message().payload)
            assert (found["quality"], found["reason"]) == (expected[0], f"speed: {expected[1]}")
            assert found["value"]["count"] == 1


def test_a_metric_of_sparkplug_has_the_status_of_its_register(instance: str) -> None:
    with plant(instance) as (segment, writer):
        block = segment.blocks["plant"]
        device = Device(block, CommandClient(block, 0), [Glob("plant/**")], elements=False)
        device.set_metrics([Metric(part, alias) for alias, part in enumerate(device.parts, 1)])
        image = first_image()
        writer.publish(bytes(image), cycle=1)
        assert [change.kind for change in device.poll()] == [DeviceEvent.BIRTH]
        image.fail(SPEED, BAD_NODE_ID_UNKNOWN, SOURCE_NS + 5 * 10**9)
        writer.publish(bytes(image), cycle=2)
        (change,) = device.poll()
        assert change.kind is DeviceEvent.DATA
        (sample,) = device.samples(change.at)
        assert (sample.metric.name, sample.quality, sample.reason) == ("speed", Quality.BAD, UNKNOWN)
        assert sample.at_ms == SOURCE_NS // 10**6 + 5000
        counts = [one for one in device.samples() if one.metric.name == "count"]
        assert [one.quality for one in counts] == [Quality.GOOD]


def test_a_dead_band_does_not_hide_that_a_register_turns_bad(instance: str) -> None:
    with plant(instance) as (segment, writer):
        follower = follow(segment.blocks["plant"])
        image, speed = first_image(), LAYOUT.registers[SPEED]
        channels = [
            RegisterChannel(follower, speed, "speed", MqttTopic("**", deadband=0.5, payload=payload))
            for payload in ("text", "json")
        ]

        def publish() -> list[bool]:
            writer.publish(bytes(image), cycle=1)
            frame = follower.newest()
            assert frame is not None
            follower.take(frame)
            moved = [channel.moved(frame.image) for channel in channels]
            for channel in channels:
                channel.message()
            return moved

        assert publish() == [True, True]
        image.put(SPEED, 1.6)
        assert publish() == [False, False]
        for code in (BAD_NODE_ID_UNKNOWN, UNCERTAIN_LAST_USABLE_VALUE, 0):
            image.put(SPEED, 1.6, 0, code)
            assert publish() == [True, True]
        assert publish() == [False, False]
