"""Publish, with well-behaved and misbehaving clients, and a device behind the source."""

from __future__ import annotations

import asyncio
import logging
import math
import struct
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager
from typing import Any

import grpc
import pytest

import shmio
from shmio.endpoints.grpc.server.call_guard import LINES, TURN_S
from shmio.layout.model import Layout
from shmio.layout.values.write import cover
from shmio.segment import EventKind, Segment
from shmio.wire import simlog_v1_pb2 as wire
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, endpoint
from tests.unit.endpoints.plant import Plant

PUBLISH = "/simulation.server.SimlogAPI/Publish"


def message(path: str, value: str = "", kind: str = "double", **content: Any) -> wire.PubRequest:
    data = wire.ROSMessage(type=kind, value=value, **content)
    return wire.PubRequest(topic=wire.TopicDescriptor(path=path), data=data)


async def publish(served: Endpoint, messages: Iterable[wire.PubRequest]) -> None:
    """Send all messages at once, half-close, and wait for the answer."""
    await served.stub.Publish(iter(messages), timeout=9 * TIMEOUT_S)  # a busy host is slow with 10 000


def counted(served: Endpoint) -> tuple[int, int]:
    return served.service.counters[2:]


async def counts(served: Endpoint, published: int, refused: int) -> None:
    async def reached() -> bool:
        return counted(served) == (published, refused)

    await served.until(reached)


@asynccontextmanager
async def plant(served: Endpoint, *, running: bool = True) -> AsyncIterator[Plant]:
    device = Plant(served.writer)
    if running:
        device.run()
    try:
        yield device
    finally:
        device.stop()


def with_plant(segment: Segment, test: Callable[[Endpoint, Plant], Awaitable[None]], *, running: bool = True) -> None:
    async def run() -> None:
        async with endpoint(segment) as served, plant(served, running=running) as device:
            await test(served, device)

    asyncio.run(run())


@pytest.mark.parametrize(
    "path", ["cell/step", "cell/step/in", "/cell/step/in", "step", "CELL://step/in", "cell://step", "cell:///step/in"]
)
def test_topic_paths_are_those_of_get_topic(segment: Segment, path: str) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, [message(path, "7")])
        assert device.memory[12:14] == b"\0\7"
        assert counted(served) == (1, 0)

    with_plant(segment, test)


@pytest.mark.parametrize(
    ("path", "text", "offset", "expected"),
    [
        ("cell/axis/position", "1.0E-4", 0, struct.pack(">f", 1.0e-4)),
        ("cell/axis/position", "-0.0", 0, struct.pack(">f", -0.0)),
        ("cell/axis/position", "NaN", 0, struct.pack(">f", math.nan)),
        ("cell/axis/position", "-Infinity", 0, struct.pack(">f", -math.inf)),
        ("cell/step", "-5.0", 12, struct.pack(">h", -5)),
        ("cell/running", "true", 8, b"\x08"),
        ("cell/inputs", "[1, 2]", 10, b"\1\2"),
        ("cell/inputs/1", "255", 11, b"\xff"),
        ("cell/bits/9", "true", 15, b"\x02"),
        ("cell/bits", "[true,false,true,true,true,true,true,true,false,true]", 14, b"\xfd\x02"),
        ("cell/name", "M\u00fcller", 16, b"\x08\x06M\xfcller"),
        ("cell/long", str([7] * 600), 26, bytes([7]) * 600),
    ],
)
def test_values_are_parsed_as_java_prints_them_whatever_the_type(
    segment: Segment, path: str, text: str, offset: int, expected: bytes
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, [message(path, text, kind="nonsense")])
        assert device.memory[offset : offset + len(expected)] == expected
        assert counted(served) == (1, 0)

    with_plant(segment, test)


def test_a_bit_leaves_its_neighbours_alone(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.memory[8] = 0xF7
        await publish(served, [message("cell/running", "true")])
        assert device.memory[8] == 0xFF
        await publish(served, [message("cell/running", "false")])
        assert device.memory[8] == 0xF7

    with_plant(segment, test)


def test_a_time_stamp_in_the_message_is_ignored(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, [message("cell/step", "3", timeStamp=wire.Header(seq=1))])
        assert device.memory[13] == 3

    with_plant(segment, test)


WRONG = [
    (message(""), "the path names no register"),
    (wire.PubRequest(), "the path names no register"),
    (message("cell/nothing", "1"), "no such register"),
    (message("nowhere://step", "1"), "unknown source"),
    (message("model/clock", "1"), "clients can only subscribe to this topic"),
    (message("cell/axis", "1"), "version 1 has no message for this structure"),
    (message("cell/inputs/2", "1"), "index [2] is outside [0..1]"),
    (message("cell/step/out", "1"), "use /in"),
    (message("cell/secret", "1"), "not writable; name it in the source's `writable` in the configuration"),
    (message("cell/step", ""), "expected a number"),
    (message("cell/step", "1.5"), "expected a whole number"),
    (message("cell/step", "40000"), "out of range"),
    (message("cell/step", "9" * 50_000), "expected a number"),
    (message("cell/axis/position", "1e999"), "out of range"),
    (message("cell/running", "maybe"), "expected true or false"),
    (message("cell/inputs", "[1]"), "expected a list of 2"),
    (message("cell/inputs", "[" * 10_000), "expected a JSON array"),
    (message("cell/name", "longer than eight"), "at most 8 are allowed"),
    (message("cell/step", point=wire.Point(x=1)), "expected a text, found a point"),
    (message("cell/step", "1", joint_trajectory=wire.JointTrajectory()), "expected a text, found a joint_trajectory"),
    (message("cell/step", safety_zone=wire.SafetyZone(zone="Z1")), "expected a text, found a safety_zone"),
]


@pytest.mark.parametrize(("wrong", "reason"), WRONG, ids=[reason[:30] for _, reason in WRONG])
def test_invalid_values_are_counted_and_logged_and_the_stream_continues(
    segment: Segment, caplog: pytest.LogCaptureFixture, wrong: wire.PubRequest, reason: str
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, [message("cell/step", "1"), wrong, message("cell/inputs/0", "9")])
        assert counted(served) == (2, 1)
        assert (device.memory[13], device.memory[10]) == (1, 9)

    with_plant(segment, test)
    (line,) = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert reason in line.getMessage()
    assert line.__dict__["fields"]["topic"] == wrong.topic.path
    assert len(line.getMessage()) < 500


def test_undecodable_bytes_do_not_end_the_stream(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        raw: Any = served.channel.stream_unary(PUBLISH)
        good = message("cell/step", "1").SerializeToString()
        utf8 = b"\x0a\x03\x0a\x01\xff"  # path that is not UTF-8
        await raw(iter([good, b"\xff\xff\xff", utf8, message("cell/step", "2").SerializeToString()]), timeout=TIMEOUT_S)
        assert counted(served) == (2, 2)
        assert device.memory[13] == 2

    with_plant(segment, test)


def test_an_immediate_half_close_is_answered(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, [])
        assert counted(served) == (0, 0)

    with_plant(segment, test, running=False)


def test_the_answer_comes_once_the_device_has_every_value(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        answer = asyncio.ensure_future(publish(served, [message("cell/step", str(n)) for n in range(1, 4)]))
        await waiting(served, device, 3)
        assert not answer.done()
        device.cycle()
        await answer
        assert device.written[-1].data == b"\0\3"
        assert counted(served) == (3, 0)

    with_plant(segment, test, running=False)


async def waiting(served: Endpoint, device: Plant, items: int) -> None:
    async def reached() -> bool:
        await asyncio.sleep(0)
        return len(device.commands._items) == items

    await served.until(reached)


def test_ten_thousand_values_at_once_keep_their_order(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, [message("cell/step", str(n)) for n in range(10_000)])
        assert counted(served) == (10_000, 0)
        values = [int.from_bytes(write.data, "big") for write in device.written if write.offset == 12]
        assert values == sorted(values)
        assert values[-1] == 9_999

    with_plant(segment, test)


def test_ten_thousand_invalid_values_do_not_fill_the_log(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        begun_s = time.monotonic()
        await publish(served, [message("cell/nothing", str(n)) for n in range(10_000)])
        turns.append(2 + int((time.monotonic() - begun_s) / TURN_S))
        assert counted(served) == (0, 10_000)
        await publish(served, [message("cell/step", "4")])
        assert device.memory[13] == 4

    turns: list[int] = []
    with_plant(segment, test)
    assert 0 < len(caplog.records) <= turns[0] * (LINES + 1)


def test_received_values_are_written_though_the_connection_drops(
    segment: Segment, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        async with grpc.aio.insecure_channel(f"127.0.0.1:{served.port}") as channel:
            call: Any = channel.stream_unary(PUBLISH)()
            for number in range(3):
                await call.write(message("cell/step", str(number)).SerializeToString())
            await waiting(served, device, 3)
            call.cancel()
        device.cycle()
        await counts(served, 3, 0)
        assert device.memory[13] == 2
        answer = asyncio.ensure_future(publish(served, [message("cell/step", "5")]))
        await waiting(served, device, 1)
        device.cycle()
        await answer

    with_plant(segment, test, running=False)
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_received_values_are_written_though_a_slowed_client_cancels(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        call: Any = served.channel.stream_unary(PUBLISH)()
        for number in range(2000):
            await call.write(message("cell/step", str(number)).SerializeToString())

        async def slowed() -> bool:
            return not served.feeds["cell"].commands.ready({"step": 1})

        await served.until(slowed)
        under_way = len(served.feeds["cell"].commands._in_flight)
        assert 50 < under_way < 2000
        call.cancel()
        device.run()
        await served.until(lambda: idle(served))
        assert under_way < counted(served)[0] <= 2000
        assert counted(served)[1] == 0

    with_plant(segment, test, running=False)


async def idle(served: Endpoint) -> bool:
    return not served.feeds["cell"].commands._in_flight and not served.service._publisher._waiting


def test_values_that_the_device_refuses_are_counted_and_logged(
    segment: Segment, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.refusal = "the address does not exist"
        await publish(served, [message("cell/step", "1"), message("cell/bits", str([1] * 10))])
        assert counted(served) == (0, 2)

    with_plant(segment, test)
    assert "publish refused: refused: the address does not exist" in caplog.text


def test_a_source_that_is_not_connected_refuses_at_once(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.lost = True
        await publish(served, [message("cell/step", "1")])
        await publish(served, [message("cell/step", str(n)) for n in range(1000)])
        assert counted(served) == (0, 1001)

    with_plant(segment, test)
    assert "unknown: the write was sent, but the device did not confirm it: cable out" in caplog.text
    assert "rejected: the source is not connected: cable out" in caplog.text


def test_commands_for_an_earlier_process_of_the_source_are_never_done(
    segment: Segment, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(served: Endpoint) -> None:
        async with plant(served, running=False) as first:
            answer = asyncio.ensure_future(publish(served, [message("cell/step", "1")]))
            await waiting(served, first, 1)
        # The first process took one command and never answers it; two more are in the queue after its end.
        late = asyncio.ensure_future(publish(served, [message("cell/step", "2"), message("cell/inputs/0", "9")]))

        async def sent() -> bool:
            return len(served.feeds["cell"].commands._in_flight) == 3

        await served.until(sent)
        served.writer = segment.writer("cell")
        async with plant(served) as second:
            await asyncio.gather(answer, late)
            assert second.written == []
            assert counted(served) == (0, 3)
            await publish(served, [message("cell/step", "3")])
            assert second.memory[13] == 3

    async def run() -> None:
        async with endpoint(segment) as served:
            await test(served)

    asyncio.run(run())
    assert "the source was restarted meanwhile" in caplog.text
    assert caplog.text.count("the source was restarted after the command was sent") == 2


def test_a_source_that_does_not_answer_delays_publishers_only_briefly(
    segment: Segment, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("shmio.local.writer.WRITE_TIMEOUT_S", 0)

    async def run() -> None:
        async with endpoint(segment) as served:
            await publish(served, [message("cell/step", str(n)) for n in range(3000)])
            assert counted(served) == (0, 3000)
            monkeypatch.setattr(
                "shmio.local.writer.WRITE_TIMEOUT_S", TIMEOUT_S
            )  # from now on the source has time to answer
            served.writer = segment.writer("cell")
            async with plant(served) as device:
                await publish(served, [message("cell/step", "3")])
                assert device.written[-1].data == b"\0\3"

    asyncio.run(run())
    assert "the source gave no answer in time" in caplog.text


def test_a_source_that_a_reload_ends_refuses_at_once(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        answer = asyncio.ensure_future(publish(served, [message("cell/step", "1")]))
        await waiting(served, device, 1)
        segment.change(retire=["cell"])
        await answer
        await publish(served, [message("cell/step", "2")])
        assert counted(served) == (0, 2)

    with_plant(segment, test, running=False)
    assert caplog.text.count("the source was changed or removed by a reload") == 2


def test_the_event_loop_runs_while_the_writable_registers_are_computed(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, known = threading.Event(), threading.Event()
    loop_thread = threading.current_thread()

    def slow(layout: Layout, patterns: Iterable[str]) -> bytes:
        assert threading.current_thread() is not loop_thread
        begun.set()
        assert known.wait(TIMEOUT_S)
        return cover(layout, patterns)

    async def test(served: Endpoint, device: Plant) -> None:
        monkeypatch.setattr("shmio.local.writer.cover", slow)
        answer = asyncio.ensure_future(publish(served, [message("cell/step", str(n)) for n in range(1, 6)]))
        other = asyncio.ensure_future(publish(served, [message("cell/inputs", "[1,2]")]))
        assert await asyncio.to_thread(begun.wait, TIMEOUT_S)
        for _ in range(3):
            assert (await served.stub.GetTopic(message("cell/step").topic, timeout=TIMEOUT_S)).msgType == "int"
        known.set()
        await asyncio.gather(answer, other)
        assert device.memory[10:14] == b"\1\2\0\5"
        assert counted(served) == (6, 0)

    with_plant(segment, test)


def test_the_source_decides_the_order_of_two_writers(segment: Segment, instance: str) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        events = served.writer.block.events.cursor()
        with shmio.attach(instance, writable=True) as guest:

            def local() -> None:
                for number in range(100):
                    assert guest.write({"cell/step": 1000 + number})[0].done

            remote = publish(served, [message("cell/step", str(number)) for number in range(500)])
            await asyncio.gather(asyncio.to_thread(local), remote)
        accepted = [event for event in iter(events.poll, None) if event.kind == EventKind.ACCEPTED]
        assert events.missed == 0
        assert {event.writer for event in accepted} == {0, 4}
        for writer in (0, 4):
            values = [event.data for event in accepted if event.writer == writer]
            assert values == sorted(values)
        assert device.memory[12:14] == accepted[-1].data
        assert counted(served) == (500, 0)

    with_plant(segment, test)


def test_many_streams_share_a_source(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        streams = [[message(f"cell/long/{n}", str(v % 256)) for v in range(200)] for n in range(1, 31)]
        await asyncio.gather(*(publish(served, messages) for messages in streams))
        assert counted(served) == (6000, 0)
        assert device.memory[26:56] == bytes([199]) * 30

    with_plant(segment, test)
