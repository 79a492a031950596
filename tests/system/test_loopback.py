"""examples/loopback, started from its file on ports of the test, with existing clients."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import grpc
import pytest

from shmio.testing.cell import PATIENCE_S, Cell, until
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as simserver
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub as V1Stub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as V2Stub
from shmio.wire.simserver_pb2_grpc import SimServerAPIStub

EXAMPLE = (Path(__file__).parents[2] / "examples/loopback/supervisor.toml").read_text()
JOINTS = ["joints/R3200/Link1/R/position", "joints/Kuka.j1/R", "joints/Kuka.j2/R", "joints/R3.L2/R"]
CONFIG = (
    EXAMPLE.replace('name = "loopback"', 'name = "{instance}"')
    .replace('"127.0.0.1:8089", "127.0.0.1:8090"', '"{grpc}"')
    .replace("period_ms = 20", "period_ms = {period_ms:g}")
)


@pytest.fixture
def loopback(make_cell: Callable[..., Cell]) -> Cell:
    cell = make_cell(config=CONFIG)
    cell.up()
    until(lambda: cell.processes()["sim"]["quality"] == "good", "good quality")
    return cell


@pytest.fixture
def channel(loopback: Cell) -> Iterator[grpc.Channel]:
    with grpc.insecure_channel(str(loopback.grpc)) as channel:
        yield channel


def values(stream: Any) -> Iterator[v1.ROSMessage]:
    """Yield the messages of a stream of version 1, without repeated values."""
    before = None
    for message in stream:
        if (message.value, message.safety_zone) != before:
            yield message
        before = message.value, message.safety_zone


class Publisher:
    """One long Publish stream, as existing clients use it."""

    def __init__(self, stub: Any) -> None:
        self._queue: SimpleQueue[v1.PubRequest | None] = SimpleQueue()
        self._call = stub.Publish.future(iter(self._queue.get, None), timeout=PATIENCE_S)

    def send(self, path: str, value: str = "", **content: Any) -> None:
        data = v1.ROSMessage(type="double", value=value, **content)
        self._queue.put(v1.PubRequest(topic=v1.TopicDescriptor(path=path), data=data))

    def close(self) -> None:
        self._queue.put(None)
        self._call.result(PATIENCE_S)


def test_published_values_come_out_in_real_time(loopback: Cell, channel: grpc.Channel) -> None:
    for part in ('name = "loopback"', '"127.0.0.1:8089", "127.0.0.1:8090"', 'name = "sim"'):
        assert part in EXAMPLE
    checked = loopback.supervisor("check")
    assert (checked.returncode, "warning" in checked.stdout + checked.stderr) == (0, False), checked.stderr
    stub: Any = V1Stub(channel)  # type: ignore[no-untyped-call]
    publisher = Publisher(stub)
    for place, path in enumerate(JOINTS, 1):
        assert stub.GetTopic(v1.TopicDescriptor(path=f"{path}/in"), timeout=PATIENCE_S).msgType == "double"
        stream = values(stub.Subscribe(v1.TopicDescriptor(path=f"/{path}/out"), timeout=PATIENCE_S))
        assert next(stream).value == "0.0"
        publisher.send(f"{path}/in", f"{place}.0E-4")
        assert next(stream).value == f"0.000{place}"
    assert stub.GetTopic(v1.TopicDescriptor(path="safetyzones/Z1"), timeout=PATIENCE_S).msgType == "SafetyZone"
    stream = values(stub.Subscribe(v1.TopicDescriptor(path="safetyzones/Z1"), timeout=PATIENCE_S))
    assert next(stream).safety_zone.zone == "Z1"
    zone = v1.SafetyZone(zone="Z1", level=0.75, object1="R3200", object2="operator")
    publisher.send("safetyzones/Z1", safety_zone=zone)
    got = next(stream)
    assert (got.value, got.WhichOneof("content")) == ("", "safety_zone")
    assert (got.safety_zone.level, got.safety_zone.object2) == (0.75, "operator")
    publisher.close()


def test_a_client_of_version_1_steps_and_sees_its_values_one_step_later(channel: grpc.Channel) -> None:
    stub: Any = V1Stub(channel)  # type: ignore[no-untyped-call]
    stub.setStepSize(v1.StepSizeRequest(step=50), timeout=PATIENCE_S)
    stream = values(stub.Subscribe(v1.TopicDescriptor(path=f"{JOINTS[0]}/out"), timeout=PATIENCE_S))
    assert next(stream).value == "0.0"
    echo = stub.Subscribe(v1.TopicDescriptor(path=f"{JOINTS[0]}/in"), timeout=PATIENCE_S)
    echo.initial_metadata()
    publisher = Publisher(stub)
    clocks = []
    for number in range(1, 21):
        publisher.send(f"{JOINTS[0]}/in", str(number / 8))
        assert next(echo).value == str(number / 8)
        assert stub.step(v1.StepRequest(), timeout=PATIENCE_S).code == 0
        got = next(stream)
        assert got.value == str(number / 8)
        clocks.append(got.timeStamp.stamp.nsec)
    publisher.close()
    assert {later - earlier for earlier, later in pairwise(clocks)} == {50_000_000}


def test_a_client_of_version_2_steps_through_simserver(channel: grpc.Channel) -> None:
    stub: Any = V2Stub(channel)  # type: ignore[no-untyped-call]
    server: Any = SimServerAPIStub(channel)  # type: ignore[no-untyped-call]
    name = "SIM://joints/Kuka.j1/R"
    info = stub.GetTopicInfo(v2.TopicInfoRequest(path=name), timeout=PATIENCE_S)
    assert (info.exists, info.type, info.direction) == (True, v2.NUMBER, v2.INOUT)
    stream = stub.CreateSubscriber(v2.Subscriber(name="test", uuid="u-1"), timeout=PATIENCE_S)
    stream.initial_metadata()
    for path in ("SIMLOG://step", f"{name}/out", "SIM://safetyzones/Z1"):
        stub.Subscribe(v2.SubscriptionRequest(path=path, subscriberUUID="u-1"), timeout=PATIENCE_S)
    steps: list[float] = []
    seen: dict[float, list[float]] = {}
    since_step: list[float] = []
    done = threading.Event()

    def listen() -> None:
        for message in stream:
            if message.header.path == "SIMLOG://step":
                steps.append(message.value.number_value)
                seen[message.value.number_value] = list(since_step)
                since_step.clear()
                if len(seen) == 11:
                    break
            elif message.header.path == f"{name}/out":
                since_step.append(message.value.number_value)
        done.set()

    listener = threading.Thread(target=listen)
    listener.start()
    for number in range(11):
        if number:
            data = v2.SimlogMessage(type=v2.NUMBER)
            data.value.number_value = number
            stub.Write(v2.PubRequest(topic=f"{name}/in", data=data), timeout=PATIENCE_S)
        status = server.step(simserver.StepRequest(deltaTime=50), timeout=PATIENCE_S)
        assert (status.deltaTime, status.alive) == (50, True)
    assert done.wait(PATIENCE_S)
    listener.join(PATIENCE_S)
    stream.cancel()
    assert steps == sorted(set(steps))
    assert [seen[step] for step in steps[1:]] == [[float(number)] for number in range(1, 11)]
