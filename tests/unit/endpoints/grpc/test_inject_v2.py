"""Inject of version 2, over real sockets: paths, and when an injection ends."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any

import grpc
import pytest

from shmio.endpoints.grpc.server.connections import connected, peer_of
from shmio.segment import Segment
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as sim
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub
from tests.unit.endpoints.grpc.services.test_publish import counted, with_plant
from tests.unit.endpoints.grpc.services.test_simlog_v1 import (
    everything,
    inject,
    laid,
    lifted,
    present_injections,
    publish,
)
from tests.unit.endpoints.grpc.services.test_simlog_v2 import read, request, write
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, message, plain, refusal
from tests.unit.endpoints.plant import Plant
from tests.unit.endpoints.stepped import Model, simulate

Status = grpc.StatusCode


async def shadow(served: Endpoint, target: str, prefix: str = "shadow/test 1", stub: Any = None) -> tuple[str, str]:
    """Inject; return the path for values and the path of the originals."""
    asked = v2.InjectRequest(targetPath=target, shadowPathPrefix=prefix)
    answer = await (stub or served.v2).Inject(asked, timeout=TIMEOUT_S)
    return answer.shadowPathIn, answer.shadowPathOut


async def reaches(served: Endpoint, device: Plant, step: bytes) -> None:
    """Wait until the device has the value.

    Write returns when the source has accepted the value. The device gets it a cycle later.
    """

    async def condition() -> bool:
        return device.memory[12:14] == step

    await served.until(condition)


async def shows(served: Endpoint, paths: Sequence[str], values: list[Any]) -> None:
    async def condition() -> bool:
        return [value for _, _, value in await read(served, *paths)] == values

    await served.until(condition)


async def info(served: Endpoint, path: str) -> tuple[int, int, bool]:
    found = await served.v2.GetTopicInfo(v2.TopicInfoRequest(path=path), timeout=TIMEOUT_S)
    return found.type, found.direction, found.exists


def test_a_typical_injecting_client(segment: Segment) -> None:
    """The client makes the calls of the wire contract, in order."""

    async def test(served: Endpoint, device: Plant) -> None:
        published: Any = served.v2.Publish(timeout=TIMEOUT_S)
        stream = await served.subscriber("injector")
        path_in, path_out = await shadow(served, "CELL://step/in")
        assert path_in.startswith("SIMLOG://shadow/test 1/")
        assert path_out.startswith("SIMLOG://shadow/test 1/")
        await write(served, path_in, 5)  # before any message was received
        await reaches(served, device, b"\0\5")
        await served.add("injector", path_out)
        await published.write(request("CELL://step/in", 7))
        await write(served, "cell/step", 8)
        assert [await message(stream) for _ in range(2)] == [(path_out, 7), (path_out, 8)]
        await write(served, path_in, -8)
        await reaches(served, device, b"\xff\xf8")
        assert await info(served, path_in) == (v2.NUMBER, v2.IN, True)
        assert await info(served, path_out) == (v2.NUMBER, v2.OUT, True)
        stream.cancel()
        await lifted(served)
        status, _ = await refusal(served.v2.Write(request(path_in, 5), timeout=TIMEOUT_S))
        assert status is Status.NOT_FOUND
        assert await info(served, path_out) == (0, 0, False)
        await published.done_writing()
        await published

    with_plant(segment, test)


def test_consumers_get_the_values_and_the_injector_the_originals(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        consumer = await served.subscriber("consumer", "cell/axis/position")
        assert await message(consumer) == ("cell/axis/position", 0)
        stream = await served.subscriber("injector")
        path_in, path_out = await shadow(served, "cell/axis/position/out")
        await served.add("injector", path_out)
        assert await message(stream) == (path_out, 0), "the current value first"
        await write(served, path_in, 1.5)
        assert await message(consumer) == ("cell/axis/position", 1.5)
        await write(served, "cell/axis/position", 2.5)
        assert await message(stream) == (path_out, 2.5)
        assert await read(served, "cell/axis/position", path_out, path_in) == [
            (v2.NUMBER, "cell/axis/position", 1.5),
            (v2.NUMBER, path_out, 2.5),
            (v2.NULL, path_in, None),
        ]
        stream.cancel()
        assert await message(consumer) == ("cell/axis/position", 2.5)
        consumer.cancel()

    with_plant(segment, test)


def test_one_prefix_gives_unique_paths_for_many_targets(segment: Segment) -> None:
    targets = [
        "cell/step/in",
        "cell/step/out",
        "cell/inputs",
        "cell/inputs/1",
        "cell/bits/3",
        "cell/axis",
        "cell/axis/speed",
    ]

    async def test(served: Endpoint, device: Plant) -> None:
        found = [await shadow(served, target, "a/b") for target in targets]
        found.append(await shadow(served, "cell/step/in", "a"))
        assert len({path for pair in found for path in pair}) == 2 * len(found)
        assert await shadow(served, "STEP/in".lower(), "SIMLOG://a//b/") == found[0], (
            "an equal request joins the injection"
        )
        assert len(present_injections(served)) == len(found)

    with_plant(segment, test)


def test_structures_and_arrays(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        stream = await served.subscriber("injector")
        axis_in, axis_out = await shadow(served, "cell/axis/in")
        inputs_in, inputs_out = await shadow(served, "cell/inputs/in")
        for path in (axis_out, inputs_out):
            await served.add("injector", path)
        assert (await info(served, axis_out))[0] == v2.STRUCT
        await write(served, "cell/axis/position", 1)
        await write(served, "cell/axis/speed", 2)
        await write(served, "cell/inputs", [3, 4])
        assert await message(stream) == (axis_out, {"position": 1, "speed": 0})
        assert await message(stream) == (axis_out, {"position": 1, "speed": 2})
        assert await message(stream) == (inputs_out, [3, 4])
        await write(served, axis_in, {"position": 0.5, "speed": 0.25})
        await write(served, inputs_in, [5, 6])
        await shows(served, ("cell/axis", "cell/inputs"), [{"position": 0.5, "speed": 0.25}, [5, 6]])
        await write(served, axis_in, {"speed": 8})
        await shows(served, ("cell/axis",), [{"position": 0.5, "speed": 8}])
        for wrong in ({}, {"position": 1, "height": 2}, {"position": {"x": 1}}, {"position": "far"}, 5, None):
            status, _ = await refusal(served.v2.Write(request(axis_in, wrong), timeout=TIMEOUT_S))
            assert status is Status.INVALID_ARGUMENT
        status, _ = await refusal(served.v2.Write(request(axis_out, {"speed": 1}), timeout=TIMEOUT_S))
        assert status is Status.FAILED_PRECONDITION
        stream.cancel()
        await lifted(served)

    with_plant(segment, test)


@pytest.mark.parametrize(
    ("target", "prefix", "status", "reason"),
    [
        ("cell/nothing/in", "p", Status.NOT_FOUND, "no such register"),
        ("cell", "p", Status.NOT_FOUND, ""),
        ("SIMLOG://step", "p", Status.NOT_FOUND, ""),
        ("cell/secret/in", "p", Status.FAILED_PRECONDITION, "not writable"),
        ("cell/axis/in", "a\0b", Status.INVALID_ARGUMENT, "printable"),
        ("cell/axis/in", "p" * 1025, Status.INVALID_ARGUMENT, "printable"),
    ],
)
def test_invalid_injections_are_refused_with_the_reason(
    segment: Segment, target: str, prefix: str, status: Status, reason: str
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        found, text = await refusal(shadow(served, target, prefix))
        assert (found, reason in text) == (status, True), text
        assert present_injections(served) == []

    with_plant(segment, test)


def test_without_a_stream_the_injection_lasts_as_long_as_the_connection(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        async with grpc.aio.insecure_channel(
            f"127.0.0.1:{served.port}", options=[("grpc.use_local_subchannel_pool", 1)]
        ) as channel:
            stub = SimlogV2Stub(channel)  # type: ignore[no-untyped-call]
            path_in, _ = await shadow(served, "cell/step/in", stub=stub)
            looked = asyncio.get_running_loop().time() + 1.0
            while asyncio.get_running_loop().time() < looked:  # several checks later it still exists
                await stub.Write(request(path_in, 5), timeout=TIMEOUT_S)
            assert len(present_injections(served)) == 1
        await lifted(served)

    with_plant(segment, test)


def test_a_client_whose_connection_is_invisible_must_subscribe_in_time(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.services.injection.connected", frozenset)

    async def test(served: Endpoint, device: Plant) -> None:
        stream = await served.subscriber("injector")
        _, path_out = await shadow(served, "cell/step/in")
        await served.add("injector", path_out)
        monkeypatch.setattr("shmio.endpoints.grpc.services.injection.UNSEEN_S", 0.0)
        await shadow(served, "cell/running/in")

        async def one_left() -> bool:
            return len(present_injections(served)) == 1

        await served.until(one_left)
        await write(served, "cell/step", 3)
        assert await message(stream) == (path_out, 3)
        stream.cancel()
        await lifted(served)

    with_plant(segment, test)


def test_the_injection_is_lifted_when_its_last_subscriber_leaves(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        first, second = await served.subscriber("first"), await served.subscriber("second")
        _, path_out = await shadow(served, "cell/step/in")
        for uuid in ("first", "second"):
            await served.add(uuid, path_out)
        first.cancel()
        await write(served, "cell/step", 3)
        assert await message(second) == (path_out, 3)
        again = await served.subscriber("second")  # replaces the earlier stream, whose topics end
        await lifted(served)
        again_in, again_out = await shadow(served, "cell/step/in")
        assert again_out == path_out
        await served.add("second", again_out)
        await write(served, "cell/step", 4)
        assert await message(again) == (path_out, 4)
        again.cancel()
        await lifted(served)
        await write(served, "cell/step", 5)
        await reaches(served, device, b"\0\5")
        assert again_in

    with_plant(segment, test)


def test_a_client_can_inject_and_subscribe_again_after_another_lifted_it(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        stream = await served.subscriber("injector", "cell/running")
        assert await message(stream) == ("cell/running", False)
        for value in (3, 4):
            _, path_out = await shadow(served, "cell/step/in")
            await served.add("injector", path_out)
            await write(served, "cell/step", value)
            assert await message(stream) == (path_out, value)
            (injection,) = served.service._shadows._users
            injection.end("a test")
            await lifted(served)
        await write(served, "cell/running", True)
        assert await message(stream) == ("cell/running", True), "the stream continues"
        stream.cancel()

    with_plant(segment, test)


def test_a_subscriber_that_does_not_read_loses_its_injection(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.streams.outbox.EVENT_BOUND", 20)

    async def test(served: Endpoint, device: Plant) -> None:
        stream = await served.subscriber("injector")
        _, path_out = await shadow(served, "cell/long/in")
        await served.add("injector", path_out)
        while present_injections(served):
            await write(served, "cell/long", [7] * 600)
        status, text = await refusal(everything(stream))
        assert status is Status.RESOURCE_EXHAUSTED
        assert "too slow" in text

    with_plant(segment, test)


def test_both_versions_share_an_injection_chain(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        inner = await laid(served, "cell/step/in", "s")
        stream = await served.subscriber("injector")
        path_in, path_out = await shadow(served, "cell/step/in")
        await served.add("injector", path_out)
        await publish(served, ("cell/step", "1"))
        assert await message(stream) == (path_out, 1)
        await publish(served, (path_in, "2"))
        assert (await inner.read()).value == "2"
        await write(served, "cell/s", 3)
        await reaches(served, device, b"\0\3")
        assert await info(served, "s") == (v2.NUMBER, v2.IN, True)
        status, _ = await refusal(inject(served, "cell/running", path_in).read())
        assert status is Status.ALREADY_EXISTS
        _, axis_out = await shadow(served, "cell/axis/in")
        status, _ = await refusal(served.subscribe(axis_out).read())
        assert status is Status.INVALID_ARGUMENT
        inner.cancel()
        stream.cancel()

    with_plant(segment, test)


KILLED = """
import sys, grpc
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as sim
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub
channel = grpc.insecure_channel(sys.argv[1])
stub = SimlogAPIStub(channel)
if sys.argv[3]:
    stream = stub.CreateSubscriber(v2.Subscriber(name="killed", uuid="k"))
    stream.initial_metadata()
answer = stub.Inject(v2.InjectRequest(targetPath=sys.argv[2], shadowPathPrefix="killed"))
if sys.argv[3]:
    stub.Subscribe(v2.SubscriptionRequest(path=answer.shadowPathOut, subscriberUUID="k"))
print(answer.shadowPathIn, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("subscribed", ["", "subscribed"])
def test_a_killed_clients_injection_is_lifted(segment: Segment, subscribed: str) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        pipe = asyncio.subprocess.PIPE
        client = await asyncio.create_subprocess_exec(
            sys.executable,
            "-c",
            KILLED,
            f"127.0.0.1:{served.port}",
            "cell/step/in",
            subscribed,
            stdin=pipe,
            stdout=pipe,
        )
        assert client.stdout is not None
        assert client.stdin is not None
        await asyncio.wait_for(client.stdout.readline(), TIMEOUT_S)
        assert len(present_injections(served)) == 1
        os.kill(client.pid, signal.SIGKILL)
        await client.wait()
        client.stdin.close()
        await lifted(served)
        await write(served, "cell/step", 6)
        await reaches(served, device, b"\0\6")

    with_plant(segment, test)


def test_the_peer_of_an_open_connection_is_found() -> None:
    async def test() -> None:
        accepted: list[asyncio.StreamWriter] = []
        server = await asyncio.start_server(lambda _, writer: accepted.append(writer), "127.0.0.1", 0)
        host, port = server.sockets[0].getsockname()
        _, writer = await asyncio.open_connection(host, port)
        mine = writer.get_extra_info("sockname")
        peer = peer_of(f"ipv4:{mine[0]}:{mine[1]}")
        assert peer is not None
        assert peer in connected()
        assert peer_of(f"ipv6:%5B::ffff:{mine[0]}%5D:{mine[1]}") == peer
        writer.close()
        await writer.wait_closed()
        assert peer not in connected()
        for other in accepted:
            other.close()
            await other.wait_closed()
        server.close()
        await server.wait_closed()

    asyncio.run(test())


@pytest.mark.parametrize("text", ["unix:", "unix:/tmp/x", "", "ipv4:300.0.0.1:5", "ipv6:::1", "ipv4:1.2.3.4:99999999"])
def test_a_peer_without_a_tcp_address_is_not_found(text: str) -> None:
    assert peer_of(text) is None


def test_values_of_an_injector_are_counted(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        path_in, _ = await shadow(served, "cell/step/out")
        await write(served, path_in, 1)
        assert counted(served) == (1, 0)
        assert plain((await served.v2.Read(v2.ReadRequest(path=["cell/step"]))).messages[0].value) == 1

    with_plant(segment, test)


def test_a_reload_ends_the_injections_of_changed_sources(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        stream = await served.subscriber("injector")
        originals = await laid(served, "cell/running/in", "s")
        _, path_out = await shadow(served, "cell/step/in")
        await served.add("injector", path_out)
        served.service.on_sources_replaced(["cell"])
        status, text = await refusal(originals.read())
        assert status is Status.ABORTED
        assert text.endswith("the source was changed or removed by a reload")
        assert await info(served, path_out) == (0, 0, False)
        await lifted(served)
        stream.cancel()

    with_plant(segment, test)


def test_in_virtual_time_originals_come_before_the_marker_of_their_step(instance: str) -> None:
    async def test(served: Endpoint, models: dict[str, Model]) -> None:
        stream = await served.subscriber("injector", "SIMLOG://step", "sim/count")
        assert await message(stream) == ("sim/count", 0)
        count_in, count_out = await shadow(served, "sim/count/out")
        goal_in, goal_out = await shadow(served, "sim/goal/in")
        await served.add("injector", count_out)
        await served.add("injector", goal_out)
        assert await message(stream) == (count_out, 0)
        await write(served, count_in, 100)
        await write(served, "sim/goal", 5)
        assert await message(stream) == (goal_out, 5), "writes are sent at once"
        await write(served, goal_in, 6)
        for number in (1, 2):
            await served.time.step(sim.StepRequest(), timeout=TIMEOUT_S)
            expected = {(count_out, number)} | ({("sim/count", 100)} if number == 1 else set())
            assert {await message(stream) for _ in expected} == expected
            assert await message(stream) == ("SIMLOG://step", number)
        assert (await read(served, "sim/reached"))[0][2] == 6
        stream.cancel()

    simulate(instance, test)
