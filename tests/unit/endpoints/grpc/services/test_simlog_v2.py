"""The unary calls of version 2, over real sockets: topic info, Write and Read."""

from __future__ import annotations

import asyncio
import logging
import math
import struct
from typing import Any

import grpc
import pytest
from google.protobuf.json_format import ParseDict
from google.protobuf.struct_pb2 import Value

from shmio.segment import Quality, Segment
from shmio.wire import simlog_v2_pb2 as v2
from tests.unit.endpoints.grpc.services.test_publish import counted, counts, with_plant
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, image, message, plain, refusal, serve
from tests.unit.endpoints.plant import Plant

Status = grpc.StatusCode
PUBLISH = "/simlog.server.SimlogAPI/Publish"


def request(path: str, value: Any = None, **kind: Any) -> v2.PubRequest:
    """Return a request that gives a topic a value: one with a JSON form, or one of Value's kinds by name."""
    data = Value(**kind) if kind else ParseDict(value, Value())
    return v2.PubRequest(topic=path, data=v2.SimlogMessage(type=v2.NULL, value=data))  # the type does not matter


async def write(served: Endpoint, path: str, value: Any = None, **kind: Any) -> None:
    await served.v2.Write(request(path, value, **kind), timeout=TIMEOUT_S)


async def read(served: Endpoint, *paths: str) -> list[tuple[int, str, Any]]:
    answer = await served.v2.Read(v2.ReadRequest(path=paths), timeout=TIMEOUT_S)
    return [(got.type, got.header.path, plain(got.value)) for got in answer.messages]


@pytest.mark.parametrize(
    ("path", "kind", "direction"),
    [
        ("cell/axis/position", v2.NUMBER, v2.INOUT),
        ("CELL://axis/position/in", v2.NUMBER, v2.IN),
        ("CELL://axis/position/out", v2.NUMBER, v2.OUT),
        ("axis/position", v2.NUMBER, v2.INOUT),
        ("cell/running", v2.BOOL, v2.INOUT),
        ("cell/name", v2.STRING, v2.INOUT),
        ("cell/inputs", v2.LIST, v2.INOUT),
        ("cell/inputs/1", v2.NUMBER, v2.INOUT),
        ("cell/bits/9/out", v2.BOOL, v2.OUT),
        ("cell/secret", v2.NUMBER, v2.OUT),
        ("cell/secret/in", v2.NUMBER, v2.IN),
        ("cell/axis", v2.STRUCT, v2.INOUT),
        ("cell/axis/in", v2.STRUCT, v2.IN),
    ],
)
def test_topic_info_gives_type_and_direction(segment: Segment, path: str, kind: int, direction: int) -> None:
    async def test(served: Endpoint) -> None:
        info = await served.v2.GetTopicInfo(v2.TopicInfoRequest(path=path), timeout=TIMEOUT_S)
        assert (info.path, info.type, info.direction, info.exists) == (path, kind, direction, True)

    serve(segment, test)


UNKNOWN = [
    "",
    "/",
    "cell",
    "cell/nothing",
    "nothing",
    "cell/inputs/2",
    "SIMLOG://steps",
    "model/time",
    "X://a",
    "%",
    "a//b",
]


@pytest.mark.parametrize("path", UNKNOWN)
def test_an_unknown_topic_has_empty_info_and_other_calls_fail_with_not_found(segment: Segment, path: str) -> None:
    async def test(served: Endpoint) -> None:
        info = await served.v2.GetTopicInfo(v2.TopicInfoRequest(path=path), timeout=TIMEOUT_S)
        assert info == v2.TopicInfo(path=path)
        stream = await served.subscriber("one")
        for call in (
            served.add("one", path),
            served.v2.Write(request(path, 1), timeout=TIMEOUT_S),
            served.v2.Read(v2.ReadRequest(path=[path]), timeout=TIMEOUT_S),
        ):
            status, text = await refusal(call)
            assert status is Status.NOT_FOUND
            assert text
        stream.cancel()

    serve(segment, test)


def test_a_typical_client_session(segment: Segment) -> None:
    """The session makes the calls of the wire contract, in order. The first Write comes before any message."""

    async def test(served: Endpoint, device: Plant) -> None:
        published: Any = served.v2.Publish(timeout=TIMEOUT_S)
        stream = served.v2.CreateSubscriber(v2.Subscriber(name="twin", uuid="5f0c"), timeout=TIMEOUT_S)
        await served.add("5f0c", "SIMLOG://step")
        await write(served, "CELL://step/in", 7)
        info = await served.v2.GetTopicInfo(v2.TopicInfoRequest(path="CELL://step"), timeout=TIMEOUT_S)
        assert (info.exists, info.direction) == (True, v2.INOUT)
        before = served.segment.clock_ns(0)
        await served.add("5f0c", "CELL://step/out")
        while (first := await stream.read()).value.number_value != 7:
            pass
        assert (first.header.path, first.type) == ("CELL://step/out", v2.NUMBER)
        assert first.header.timestamp.ToNanoseconds() > before
        await published.write(request("CELL://step/in", 8))
        assert await message(stream) == ("CELL://step/out", 8.0)
        await published.done_writing()
        await published
        stream.cancel()

    with_plant(segment, test)


@pytest.mark.parametrize(
    ("path", "kind", "value", "offset", "expected"),
    [
        ("cell/axis/position", "number_value", 0.1, 0, struct.pack(">f", 0.1)),
        ("cell/axis/position", "number_value", math.nan, 0, struct.pack(">f", math.nan)),
        ("cell/axis/position", "number_value", -math.inf, 0, struct.pack(">f", -math.inf)),
        ("cell/axis/position", "string_value", "1.0E-4", 0, struct.pack(">f", 1.0e-4)),
        ("cell/step", "number_value", -5.0, 12, struct.pack(">h", -5)),
        ("cell/running", "bool_value", True, 8, b"\x08"),
        ("cell/running", "number_value", 1, 8, b"\x08"),
        ("cell/running", "string_value", "true", 8, b"\x08"),
        ("cell/inputs/1", "number_value", 255, 11, b"\xff"),
        ("cell/inputs", "string_value", "[3,4]", 10, b"\3\4"),
        ("cell/name", "string_value", "M\u00fcller", 16, b"\x08\x06M\xfcller"),
        ("cell/name", "string_value", "12", 16, b"\x08\x0212"),
    ],
)
def test_write_and_publish_take_values_of_any_fitting_kind(
    segment: Segment, path: str, kind: str, value: Any, offset: int, expected: bytes
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await served.v2.PublishSynch(request(path, **{kind: value}), timeout=TIMEOUT_S)
        await counts(served, 1, 0)
        assert device.memory[offset : offset + len(expected)] == expected
        device.memory[:] = bytes(len(device.memory))
        await served.v2.Publish(iter([request(path, **{kind: value})]), timeout=TIMEOUT_S)
        assert device.memory[offset : offset + len(expected)] == expected

    with_plant(segment, test)


def test_lists_are_written_to_arrays(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await write(served, "cell/inputs", [1, 2])
        await write(served, "cell/bits", [True, False] * 5)
        await counts(served, 2, 0)
        assert device.memory[10:16] == b"\1\2\0\0\x55\1"

    with_plant(segment, test)


REFUSED = [
    (request("cell/step/out", 1), Status.FAILED_PRECONDITION, "use /in"),
    (request("cell/secret", 1), Status.FAILED_PRECONDITION, "name it in the source's `writable`"),
    (request("cell/axis", 1), Status.INVALID_ARGUMENT, "axis: expected a structure"),
    (request("cell/axis", {}), Status.INVALID_ARGUMENT, "with some of its members, found none"),
    (request("cell/axis", {"position": 1, "torque": 1}), Status.INVALID_ARGUMENT, "axis/torque: the structure has no"),
    (request("cell/axis", {"position": {"x": 1}}), Status.INVALID_ARGUMENT, "axis/position: expected a value"),
    (request("cell/step", 1.5), Status.INVALID_ARGUMENT, "expected a whole number"),
    (request("cell/step", 40_000), Status.INVALID_ARGUMENT, "out of range"),
    (request("cell/step", "seven"), Status.INVALID_ARGUMENT, "expected a number"),
    (request("cell/step", True), Status.INVALID_ARGUMENT, "expected a whole number"),
    (request("cell/step", number_value=math.nan), Status.INVALID_ARGUMENT, "expected a whole number"),
    (request("cell/step", [1]), Status.INVALID_ARGUMENT, "expected a whole number"),
    (request("cell/step", {"a": 1}), Status.INVALID_ARGUMENT, "found a structure"),
    (request("cell/step", None), Status.INVALID_ARGUMENT, "found none"),
    (v2.PubRequest(topic="cell/step"), Status.INVALID_ARGUMENT, "found none"),
    (request("cell/axis/position", 1e300), Status.INVALID_ARGUMENT, "out of range"),
    (request("cell/inputs", [1]), Status.INVALID_ARGUMENT, "expected a list of 2"),
    (request("cell/inputs", [1, [2]]), Status.INVALID_ARGUMENT, "expected a whole number"),
    (request("cell/inputs", [1, None]), Status.INVALID_ARGUMENT, "found none"),
    (request("cell/running", 2), Status.INVALID_ARGUMENT, "expected true or false"),
    (request("cell/name", 5), Status.INVALID_ARGUMENT, "expected text"),
    (request("cell/name", "longer than eight"), Status.INVALID_ARGUMENT, "at most 8 are allowed"),
]


@pytest.mark.parametrize(("wrong", "status", "reason"), REFUSED, ids=[reason for _, _, reason in REFUSED])
def test_invalid_writes_are_refused_with_the_reason(
    segment: Segment, caplog: pytest.LogCaptureFixture, wrong: v2.PubRequest, status: Status, reason: str
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        found, text = await refusal(served.v2.Write(wrong, timeout=TIMEOUT_S))
        assert (found, reason in text) == (status, True), text
        assert counted(served) == (0, 1)
        assert caplog.records == []  # its writer knows from the status
        await served.v2.Publish(iter([wrong, request("cell/inputs/0", 9)]), timeout=TIMEOUT_S)
        assert counted(served) == (1, 2)
        assert device.memory[10] == 9

    with_plant(segment, test)
    (line,) = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert reason in line.getMessage()


def test_write_returns_once_the_source_has_accepted_the_value(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await write(served, "cell/step", 3)
        assert device.written == []
        await write(served, "cell/long", [7] * 600)  # its data span several events
        assert counted(served) == (0, 0)
        device.cycle()
        await counts(served, 2, 0)
        assert device.memory[12:14] == b"\0\3"

    with_plant(segment, test, running=False)


def test_a_later_refusal_by_the_device_is_logged(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.refusal = "the address does not exist"
        await write(served, "cell/step", 3)
        device.cycle()
        await counts(served, 0, 1)

    with_plant(segment, test, running=False)
    assert "publish refused: refused: the address does not exist" in caplog.text


def test_a_source_that_is_not_connected_refuses_a_write_at_once(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.commands.close("cable out")
        status, text = await refusal(served.v2.Write(request("cell/step", 1), timeout=TIMEOUT_S))
        assert status is Status.FAILED_PRECONDITION
        assert text == "cell/step: rejected: the source is not connected: cable out"

    with_plant(segment, test)


def test_a_source_that_does_not_answer_leaves_a_write_unknown(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.local.writer.WRITE_TIMEOUT_S", 0)

    async def test(served: Endpoint) -> None:
        status, text = await refusal(served.v2.Write(request("cell/step", 1), timeout=TIMEOUT_S))
        assert status is Status.DEADLINE_EXCEEDED
        assert "it is not known whether the value was written" in text
        assert counted(served) == (0, 1)

    serve(segment, test)


def test_cancelled_writes_do_not_disturb_others(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        calls = [served.v2.Write(request("cell/step", n), timeout=TIMEOUT_S) for n in range(1000)]
        for call in calls[::2]:
            call.cancel()
        status, _ = await refusal(served.v2.Write(request("cell/step", 1), timeout=1e-6))
        assert status is Status.DEADLINE_EXCEEDED
        device.run()
        await asyncio.gather(*calls[1::2])
        await write(served, "cell/step", 77)

        async def idle() -> bool:
            return not served.feeds["cell"].commands._in_flight

        await served.until(idle)
        assert device.memory[12:14] == b"\0\x4d"

    with_plant(segment, test, running=False)


def test_publish_skips_undecodable_bytes_and_ends_with_its_connection(
    segment: Segment, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        raw: Any = served.channel.stream_unary(PUBLISH)
        good = request("cell/step", 1).SerializeToString()
        await raw(iter([good, b"\xff\xff\xff", b"\x0a\x01\xff", good]), timeout=TIMEOUT_S)
        assert counted(served) == (2, 2)
        async with grpc.aio.insecure_channel(f"127.0.0.1:{served.port}") as channel:
            call: Any = channel.stream_unary(PUBLISH)()
            await call.write(request("cell/step", 5).SerializeToString())
            await counts(served, 3, 2)
        await write(served, "cell/step", 6)
        await counts(served, 4, 2)

    with_plant(segment, test)
    assert caplog.text.count("bytes are not a valid PubRequest") == 2


def test_all_values_of_a_read_are_of_one_frame(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(position=0.5, running=True, inputs=b"\1\2", step=-3))
        assert await read(served, "CELL://step", "cell/running/out", "inputs", "cell/axis", "cell/name/in", "step") == [
            (v2.NUMBER, "CELL://step", -3.0),
            (v2.BOOL, "cell/running/out", True),
            (v2.LIST, "inputs", [1.0, 2.0]),
            (v2.STRUCT, "cell/axis", {"position": 0.5, "speed": 0.0}),
            (v2.STRING, "cell/name/in", ""),
            (v2.NUMBER, "step", -3.0),
        ]
        frame = served.feeds["cell"].block.latest()
        assert frame is not None
        answer = await served.v2.Read(v2.ReadRequest(path=["cell/step"]), timeout=TIMEOUT_S)
        assert answer.messages[0].header.timestamp.ToNanoseconds() == frame.clock_ns
        assert await read(served) == []

    serve(segment, test)


def test_a_read_never_mixes_frames(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        for number in range(200):
            served.publish(image(position=number, speed=number, step=number))
            values = {value for _, _, value in await read(served, "cell/axis/position", "cell/axis/speed", "cell/step")}
            assert len(values) == 1

    serve(segment, test)


def test_bad_values_are_read_as_null(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        assert await read(served, "cell/step") == [(v2.NULL, "cell/step", None)]
        served.publish(image(step=1), Quality.BAD)
        assert await read(served, "cell/step", "cell/axis") == [
            (v2.NULL, "cell/step", None),
            (v2.NULL, "cell/axis", None),
        ]
        served.publish(image()[:17] + b"\x09" + image()[18:])  # a STRING[8] with length 9
        assert await read(served, "cell/name", "cell/step") == [
            (v2.NULL, "cell/name", None),
            (v2.NUMBER, "cell/step", 0.0),
        ]

    serve(segment, test)


def test_a_read_of_too_many_values_is_refused(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.services.simlog_v2.MAX_ELEMENTS", 700)

    async def test(served: Endpoint) -> None:
        served.publish(image())
        assert len(await read(served, "cell/long", *["cell/step"] * 100)) == 101
        for paths in (["cell/long"] * 2, ["cell/step"] * 701, ["cell/step"] * 5000):
            status, text = await refusal(served.v2.Read(v2.ReadRequest(path=paths), timeout=TIMEOUT_S))
            assert status is Status.INVALID_ARGUMENT
            assert "too much for one Read" in text

    serve(segment, test)
