"""Time that an instance's endpoint plays, also after the endpoint's process has ended."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import grpc
import pytest
from google.protobuf.empty_pb2 import Empty

import shmio
from shmio.testing.cell import PATIENCE_S, Cell, kill, until
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as sim
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub
from shmio.wire.simserver_pb2_grpc import SimServerAPIStub
from tests.system.campaign import CONFIG, NOISY, PANEL

pytestmark = pytest.mark.timeout(240)


@pytest.fixture
def cell(make_cell: Callable[..., Cell]) -> Cell:
    """Start a cell with models, noise and a memory, with time at 0."""
    cell = make_cell(config=CONFIG)
    (cell.folder / "panel.toml").write_text(PANEL)
    (cell.folder / "noisy.py").write_text(NOISY)
    cell.up()
    until(lambda: all(cell.processes()[name]["quality"] == "good" for name in ("sim", "noise", "panel")), "good")
    return cell


def markers(channel: grpc.Channel, uuid: str) -> Any:
    """Return a stream of step numbers."""
    stub: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
    stream = stub.CreateSubscriber(v2.Subscriber(name=uuid, uuid=uuid), timeout=PATIENCE_S, wait_for_ready=True)
    stub.Subscribe(v2.SubscriptionRequest(path="SIMLOG://step", subscriberUUID=uuid), timeout=PATIENCE_S)
    return stream


def end(cell: Cell, how: str) -> None:
    """End the endpoint's process, and wait for its successor."""
    pid = cell.processes()["grpc"]["pid"]
    if how == "killed":
        kill(pid)
    else:
        assert cell.supervisor("restart", "grpc").returncode == 0
    until(lambda: cell.processes()["grpc"]["pid"] not in (pid, None), "a successor")


@pytest.mark.parametrize("how", ["killed", "restarted"])
def test_the_endpoints_successor_continues_playing(cell: Cell, how: str) -> None:
    with shmio.attach(cell.instance) as local:
        with grpc.insecure_channel(str(cell.grpc)) as channel:
            time: Any = SimServerAPIStub(channel)  # type: ignore[no-untyped-call]
            stream = markers(channel, "one")
            time.start(sim.StartRequest(deltaTime=10), timeout=PATIENCE_S)
            assert [next(stream).value.number_value for _ in range(5)] == [1, 2, 3, 4, 5]
        end(cell, how)
        until(lambda: cell.processes()["grpc"]["state"] == "running", "the successor serves")
        with grpc.insecure_channel(str(cell.grpc)) as channel:
            stream = markers(channel, "two")
            first = next(stream).value.number_value
            assert [next(stream).value.number_value for _ in range(4)] == [first + n for n in (1, 2, 3, 4)]
            time = SimServerAPIStub(channel)  # type: ignore[no-untyped-call]
            paused = time.pause(Empty(), timeout=PATIENCE_S)
            assert (paused.playing, paused.alive) == (False, True)
            clock = local.clock
            assert not clock.playing
            assert clock.dt_ns == 10_000_000
            assert clock.time_ns == 10_000_000 * clock.step
            status = time.step(sim.StepRequest(), timeout=PATIENCE_S)
            assert (status.clock, status.deltaTime) == (clock.time_ns // 1_000_000 + 50, 50)


def test_a_model_that_is_killed_while_time_plays_rejoins(cell: Cell) -> None:
    with grpc.insecure_channel(str(cell.grpc)) as channel:
        time: Any = SimServerAPIStub(channel)  # type: ignore[no-untyped-call]
        stream = markers(channel, "one")
        time.start(sim.StartRequest(deltaTime=10), timeout=PATIENCE_S)
        before = next(stream).value.number_value
        pid = cell.processes()["noise"]["pid"]
        kill(pid)
        until(lambda: cell.processes()["noise"]["pid"] not in (pid, None), "a successor")
        numbers = [before, *(next(stream).value.number_value for _ in range(200))]
        assert numbers == sorted(set(numbers)), "strictly increasing"
        assert not time.pause(Empty(), timeout=PATIENCE_S).playing
