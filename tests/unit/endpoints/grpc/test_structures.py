"""Structures of known types: message types of version 1, and values of version 2."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from grpc import StatusCode

from shmio.layout.simlog_structures import CONTENTS
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment
from shmio.wire import simlog_v1_pb2 as wire
from tests.unit.endpoints.grpc.services.test_publish import counted, counts, publish, with_plant
from tests.unit.endpoints.grpc.services.test_publish import message as request
from tests.unit.endpoints.grpc.services.test_simlog_v2 import write
from tests.unit.endpoints.harness import STALE_NS, TIMEOUT_S, Endpoint, message, refusal, serve
from tests.unit.endpoints.plant import Plant

LENGTHS = {"JointTrajectoryPoint": "[3]", "JointTrajectory": "[3, 2]"}
LAYOUT = place_tags(
    "cell",
    {"safetyzones/Z1": "SafetyZone"}
    | {f"known/{shape}": f"{shape}{LENGTHS.get(shape, '')}" for shape in CONTENTS}
    | {"partly/x": "REAL", "partly/y": "REAL", "partly/z": "REAL", "other/a": "REAL"},
)
WRITABLE = ("safetyzones", "known", "partly/x", "partly/y")
ZONE = wire.SafetyZone(
    header=wire.Header(seq=7, stamp=wire.time(sec=3, nsec=3_000_000_001), frame_id="world"),
    zone="Z1",
    level=0.5,
    object1="Kuka",
    object2="Müller",
)


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, STALE_NS, 1 << 20, Attributes("test", WRITABLE))
    with Segment.create(instance, [block], [ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]) as segment:
        yield segment
        segment.unlink()


def image(**values: object) -> bytes:
    """Return a block's image with these values. In the names, __ stands for a slash."""
    frame = bytearray(LAYOUT.size)
    for name, value in values.items():
        codec(find(LAYOUT, name.replace("__", "/")), "little").encode_into(value, frame)
    return bytes(frame)


def held(device: Plant, path: str) -> object:
    return codec(find(LAYOUT, path), "little").decode(device.memory)


async def received(stream: Any) -> wire.ROSMessage:
    got: wire.ROSMessage = await asyncio.wait_for(stream.read(), TIMEOUT_S)
    return got


@pytest.mark.parametrize("shape", CONTENTS)
def test_each_shape_is_served_as_its_own_message_type(segment: Segment, shape: str) -> None:
    async def test(served: Endpoint) -> None:
        topic = await served.stub.GetTopic(wire.TopicDescriptor(path=f"cell/known/{shape}"), timeout=TIMEOUT_S)
        assert topic.msgType == shape
        served.publish(image())
        got = await received(served.subscribe(f"known/{shape}"))
        assert (got.type, got.value, got.WhichOneof("content")) == (shape, "", CONTENTS[shape])

    serve(segment, test)


def test_a_safety_zone_is_sent_when_any_member_changes(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(safetyzones__Z1__zone="Z1", safetyzones__Z1__level=0.1))
        stream = served.subscribe("safetyzones/Z1")
        first = await received(stream)
        zone = wire.SafetyZone(header=wire.Header(stamp=wire.time()), zone="Z1", level=0.1)
        assert first == wire.ROSMessage(type="SafetyZone", safety_zone=zone)
        served.publish(image(safetyzones__Z1__zone="Z1", safetyzones__Z1__level=0.1, other__a=1.0))
        served.publish(image(safetyzones__Z1__zone="Z1", safetyzones__Z1__header__seq=5))
        second = await received(stream)
        assert (second.safety_zone.level, second.safety_zone.header.seq) == (0.0, 5)

    serve(segment, test)


def test_a_trajectory_is_served_with_all_its_elements(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(
            image(
                known__JointTrajectory__joint_names=["a", "b", "c"],
                known__JointTrajectory__points__1__positions=[1, 2, 3],
                known__JointTrajectory__points__1__time_from_start__msec=20,
            )
        )
        got = (await received(served.subscribe("known/JointTrajectory"))).joint_trajectory
        assert list(got.joint_names) == ["a", "b", "c"]
        assert [list(point.positions) for point in got.points] == [[0, 0, 0], [1, 2, 3]]
        assert [point.time_from_start.msec for point in got.points] == [0, 20]

    serve(segment, test)


def test_a_published_structure_is_written_in_one_command(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        listener = served.subscribe("safetyzones/Z1/in")
        await listener.initial_metadata()
        await publish(served, [request("safetyzones/Z1", kind="SafetyZone", safety_zone=ZONE)])
        assert counted(served) == (1, 0)
        assert held(device, "safetyzones/Z1/level") == 0.5
        assert held(device, "safetyzones/Z1/object2") == "Müller"
        assert held(device, "safetyzones/Z1/header/stamp/nsec") == 3_000_000_001
        assert await received(listener) == wire.ROSMessage(type="SafetyZone", safety_zone=ZONE)
        assert await received(served.subscribe("safetyzones/Z1")) == wire.ROSMessage(
            type="SafetyZone", safety_zone=ZONE
        )

    with_plant(segment, test)


def test_fields_missing_in_the_message_keep_their_value_and_short_lists_are_filled(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        point = wire.JointTrajectoryPoint(positions=[1, 2, 3], effort=[4], time_from_start=wire.duration(msec=9))
        await publish(
            served,
            [
                request("safetyzones/Z1", safety_zone=ZONE),
                request("safetyzones/Z1", safety_zone=wire.SafetyZone(zone="Z2")),
                request("known/JointTrajectoryPoint", joint_trajectory_point=point),
                request(
                    "known/JointTrajectory",
                    joint_trajectory=wire.JointTrajectory(joint_names=["a"], points=[point]),
                ),
                request("known/Header", timeStamp=wire.Header(seq=2**32 - 1)),
            ],
        )
        assert counted(served) == (5, 0)
        assert held(device, "safetyzones/Z1/zone") == "Z2"
        assert held(device, "safetyzones/Z1/level") == 0
        assert held(device, "safetyzones/Z1/header/seq") == 7
        assert held(device, "known/JointTrajectoryPoint/effort") == [4, 0, 0]
        assert held(device, "known/JointTrajectoryPoint/velocities") == [0, 0, 0]
        assert held(device, "known/JointTrajectory/joint_names") == ["a", "", ""]
        assert held(device, "known/JointTrajectory/points/0/time_from_start/msec") == 9
        assert held(device, "known/JointTrajectory/points/1/positions") == [0, 0, 0]
        assert held(device, "known/Header/seq") == 2**32 - 1

    with_plant(segment, test)


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (request("safetyzones/Z1", "1.0"), "safetyzones/Z1: expected a safety_zone, found a text"),
        (request("safetyzones/Z1", point=wire.Point(x=1)), "safetyzones/Z1: expected a safety_zone, found a point"),
        (request("safetyzones/Z1", timeStamp=wire.Header()), "expected a safety_zone, found a timeStamp"),
        (request("safetyzones/Z1", safety_zone=wire.SafetyZone(zone="Z" * 81)), "at most 80 are allowed"),
        (
            request("known/JointTrajectoryPoint", joint_trajectory_point=wire.JointTrajectoryPoint(effort=[1] * 4)),
            "known/JointTrajectoryPoint/effort: expected at most 3 elements, found 4",
        ),
        (
            request(
                "known/JointTrajectory",
                joint_trajectory=wire.JointTrajectory(points=[wire.JointTrajectoryPoint()] * 3),
            ),
            "points: expected at most 2 values, found 3",
        ),
        (request("partly", point=wire.Point(x=1)), "cell/partly/z is not writable"),
        (request("other", point=wire.Point(x=1)), "other: version 1 has no message for this structure"),
        (request("known/Point/x", point=wire.Point(x=1)), "known/Point/x: expected a text, found a point"),
    ],
)
def test_a_structure_that_does_not_fit_is_refused_as_a_whole(
    segment: Segment, caplog: pytest.LogCaptureFixture, wrong: wire.PubRequest, reason: str
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, [wrong])
        assert counted(served) == (0, 1)
        assert reason in caplog.text
        assert device.written == []

    with_plant(segment, test)


@pytest.mark.parametrize("path", ["cell/other", "cell/known", "cell"])
def test_other_structures_are_refused(segment: Segment, path: str) -> None:
    async def test(served: Endpoint) -> None:
        topic = wire.TopicDescriptor(path=path)
        for call in (served.stub.GetTopic(topic, timeout=TIMEOUT_S), served.subscribe(path).read()):
            status, text = await refusal(call)
            assert status is StatusCode.INVALID_ARGUMENT
            assert "version 1" in text

    serve(segment, test)


def test_the_members_of_a_structure_fail_together(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.refusal = "device says no"
        await publish(served, [request("safetyzones/Z1", safety_zone=ZONE)])
        assert counted(served) == (0, 1)
        assert caplog.text.count("device says no") == 1

    with_plant(segment, test)


def test_version_2_takes_structures_member_by_member(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        stream = await served.subscriber("u", "cell/safetyzones/Z1")
        await write(
            served, "cell/safetyzones/Z1", {"level": 2.5, "header": {"stamp": {"nsec": "18446744073709551615"}}}
        )
        await counts(served, 1, 0)
        assert held(device, "safetyzones/Z1/level") == 2.5
        assert held(device, "safetyzones/Z1/header/stamp/nsec") == 2**64 - 1
        with suppress(TimeoutError):
            while (await message(stream))[1]["level"] != 2.5:
                pass

    with_plant(segment, test)
