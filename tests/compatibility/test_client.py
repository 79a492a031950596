"""A client that was built from the ``.proto`` files of an earlier version talks to an endpoint of this version."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import grpc
import pytest

from shmio.testing.cell import Cell
from tests.compatibility.wire import OldClient, stored

V1 = "simulation.server.SimlogAPI"
V2 = "simlog.server.SimlogAPI"
TIME = "com.ttsnetwork.simulator3.SimServerAPI"
OURS = "shmio.v1.Shmio"
JOINT = "joints/Kuka.j1/R"


@pytest.fixture
def client(baseline: Path, live: Cell) -> Iterator[OldClient]:
    with grpc.insecure_channel(str(live.grpc)) as channel:
        yield OldClient(stored(baseline), channel)


def until_value(stream: Any, wanted: str) -> Any:
    return next(message for message in stream if message.value == wanted)


def topic(path: str) -> dict[str, Any]:
    return {"path": path}


def test_version_1(client: OldClient) -> None:
    found = client.call(V1, "GetTopic", path=f"{JOINT}/in")
    assert (found.path, found.msgType) == (f"{JOINT}/in", "double")
    stream = client.call(V1, "Subscribe", path=f"/{JOINT}/out")
    client.call(V1, "Publish", [{"topic": topic(f"{JOINT}/in"), "data": {"type": "double", "value": "1.0E-4"}}])
    got = until_value(stream, "0.0001")
    assert (got.type, got.WhichOneof("content")) == ("double", "timeStamp")
    assert 0 < got.timeStamp.stamp.nsec == pytest.approx(got.timeStamp.stamp.sec * 1e9, abs=1e9)
    originals = client.call(V1, "Inject", injected=topic(f"{JOINT}/shadow"), target=topic(f"{JOINT}/out"))
    assert next(originals).value == "0.0001"
    client.call(V1, "Publish", [{"topic": topic(f"{JOINT}/shadow"), "data": {"type": "double", "value": "7.5"}}])
    until_value(stream, "7.5")
    originals.cancel()
    until_value(stream, "0.0001")
    zone = {"zone": "Z1", "level": 0.75, "object1": "R3200", "object2": "operator"}
    zones = client.call(V1, "Subscribe", path="safetyzones/Z1")
    client.call(V1, "Publish", [{"topic": topic("safetyzones/Z1"), "data": {"safety_zone": zone}}])
    got = next(message for message in zones if message.safety_zone.level)
    assert (got.safety_zone.zone, got.safety_zone.level, got.safety_zone.object2) == ("Z1", 0.75, "operator")
    for one in (stream, zones):
        one.cancel()


def number(client: OldClient, value: float) -> Any:
    return client.message(
        "simlog.server.SimlogMessage", type=3, value=client.message("google.protobuf.Value", number_value=value)
    )


def test_version_2(client: OldClient) -> None:
    name = "SIM://joints/Kuka.j2/R"
    info = client.call(V2, "GetTopicInfo", path=name)
    assert (info.path, info.exists, info.type, info.direction) == (name, True, 3, 3)
    stream = client.call(V2, "CreateSubscriber", name="old", uuid="u-1")
    stream.initial_metadata()
    client.call(V2, "Subscribe", path=f"{name}/out", subscriberUUID="u-1")
    client.call(V2, "Write", topic=f"{name}/in", data=number(client, 0.125))
    got = next(message for message in stream if message.value.number_value == 0.125)
    assert (got.header.path, got.type, got.header.timestamp.seconds >= 0) == (f"{name}/out", 3, True)
    [read] = client.call(V2, "Read", path=[f"{name}/out"]).messages
    assert read.value.number_value == 0.125
    shadow = client.call(V2, "Inject", targetPath=f"{name}/out", shadowPathPrefix="old")
    client.call(V2, "Subscribe", path=shadow.shadowPathOut, subscriberUUID="u-1")
    client.call(V2, "Write", topic=shadow.shadowPathIn, data=number(client, 0.5))
    paths = {shadow.shadowPathOut: 0.125, f"{name}/out": 0.5}
    while paths:
        message = next(stream)
        if paths.get(message.header.path) == message.value.number_value:
            del paths[message.header.path]
    stream.cancel()


def test_steps_of_simserver_and_of_version_1(client: OldClient, live: Cell) -> None:
    watched = client.call(TIME, "subscribe")
    watched.initial_metadata()
    try:
        before = client.call(TIME, "step", deltaTime=20)
        assert (before.deltaTime, before.alive, before.playing, before.exitCode) == (20, True, False, 0)
        assert client.call(TIME, "step", deltaTime=50).clock == before.clock + 50
        assert next(status for status in watched if status.clock == before.clock + 50).deltaTime == 50
        client.call(V1, "setStepSize", step=30)
        assert client.call(V1, "step").code == 0
        clock = client.call(OURS, "Step", dt_ns=5_000_000)
        assert (clock.virtual, clock.time_ns // 1_000_000, clock.step_size_ns) == (True, before.clock + 85, 30_000_000)
        assert client.call(TIME, "start", deltaTime=20).playing
        assert not client.call(TIME, "pause").playing
    finally:
        live.output("shmio", "step", "--release", "--host", str(live.grpc))
        watched.cancel()


def test_shmio_v1_layouts_and_status(client: OldClient, live: Cell) -> None:
    [part] = client.call(OURS, "GetLayouts", sources=["notes"])
    assert (part.source, part.name, part.big_endian, part.last, list(part.writable)) == (
        ("notes", "notes", True, True, ["**"])
    )
    assert (part.period_ns, len(part.hash), part.size) == (50_000_000, 32, 52)
    [row] = [one for one in part.registers if one.path == "row"]
    assert (row.type, row.offset, row.size, row.count, row.dims[0].low, row.dims[0].high) == ("INT", 34, 6, 3, 1, 3)
    status = client.call(OURS, "GetStatus")
    assert (status.instance, status.mode, status.state) == (live.instance, "live", "running")
    [notes] = [one for one in status.processes if one.name == "notes"]
    assert (notes.kind, notes.pid, notes.state) == ("source", live.processes()["notes"]["pid"], "running")
    assert (notes.source.quality, notes.source.cycle > 0, notes.counters["polls"] > 0) == ("good", True, True)


def test_shmio_v1_reads_writes_and_subscribes(client: OldClient) -> None:
    stream = client.call(OURS, "Subscribe", patterns=["notes/count", "notes/level"], mode=1)
    first = next(stream)
    [table] = first.tables
    columns = {one.path: (one.column, one.slot) for one in table.registers}
    assert columns == {"level": (5, 0), "count": (2, 0)}
    for value in (0, -70000):
        values = [{"path": "notes/count", "value": {"integer": value}}]
        [outcome] = client.call(OURS, "Write", values=values).outcomes
        assert outcome.kind == 1
    update = next(one for message in stream for one in message.updates if -70000 in one.values.int32s.values)
    assert (update.table, update.quality, update.provenance) == (table.number, 2, 1)
    assert (update.frame > 0, update.cycle > 0, update.clock_ns > 0, update.incarnation) == (True, True, True, 1)
    answer = client.call(OURS, "Read", patterns=["notes/level"], originals=True)
    [read] = answer.updates
    assert list(read.values.floats.values) == [1.75]
    assert list(read.originals.floats.values) == [1.5]
    assert list(read.injected.registers) == [0]
    stream.cancel()


def test_shmio_v1_injects(client: OldClient) -> None:
    asked: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
    asked.put({"lay": {"patterns": ["notes/word"], "name": "old client", "priority": 3}})
    stream = client.call(OURS, "Inject", iter(asked.get, None))
    laid = next(stream).laid
    [register] = laid.table.registers
    assert (register.path, register.column) == ("word", 2)
    asked.put({"shadow": {"sequence": 1, "assignments": [{"path": "notes/word", "value": {"integer": 7}}]}})
    answer = next(answer for message in stream for answer in message.answers)
    assert (answer.sequence, answer.outcome.kind) == (1, 6)
    listed = client.call(OURS, "ListInjections").injections
    [mine] = [one for one in listed if one.number == laid.number]
    assert (mine.name, mine.source, mine.priority) == ("old client", "notes", 3)
    [drift] = [one for one in listed if one.name == "drift"]
    assert (drift.running.declaration.offset.number, drift.running.state) == (0.25, 2)
    [update] = client.call(OURS, "Read", patterns=["notes/word"]).updates
    assert list(update.values.int32s.values) == [7]
    client.call(OURS, "Lift", source="notes", number=laid.number)
    asked.put(None)
    [update] = client.call(OURS, "Read", patterns=["notes/word"]).updates
    assert list(update.values.int32s.values) == [0xBEEF]
