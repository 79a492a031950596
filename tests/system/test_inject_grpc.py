"""Inject of both SimlogAPI versions in whole cells, also when clients or endpoints are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import grpc
import pytest
from google.protobuf.struct_pb2 import Value

import shmio
from shmio.local.attach import Attachment
from shmio.segment import Frame
from shmio.testing.cell import PATIENCE_S, Cell, kill, until
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub
from tests.system.armed import ARMED, UNARMED

MEMORY = """
[[source]]
name = "sim"
connector = "memory"
layout = "joints.toml"
writable = ["**"]
"""
JOINTS = '[registers]\n"joints/R3200/Link1/R/position" = "LREAL"\n"joints/Kuka.j1/R" = "REAL"\n'
POSITION = "joints/R3200/Link1/R/position"
PLACE = "cell/Outputs/100"  # the controller's program ignores it


@pytest.fixture(scope="module")
def cell(make_shared_cell: Callable[..., Cell]) -> Cell:
    """Start the A50 cell with injections toward the controller, a second source without them, and a memory.

    The memory has the joints that existing clients use. Each test lifts its injections.
    """
    cell = make_shared_cell(config=(ARMED + UNARMED + MEMORY).replace("[grpc]\n", '[grpc]\ndefault_source = "sim"\n'))
    (cell.folder / "joints.toml").write_text(JOINTS)
    cell.up()
    until(lambda: all(cell.processes()[name]["quality"] == "good" for name in ("cell", "sim")), "good quality")
    return cell


@pytest.fixture
def local(cell: Cell) -> Iterator[Attachment]:
    with shmio.attach(cell.instance) as local:
        yield local


@contextmanager
def client(cell: Cell) -> Iterator[tuple[Any, Any]]:
    """Yield stubs of both versions, over a separate connection."""
    with grpc.insecure_channel(str(cell.grpc), [("grpc.use_local_subchannel_pool", 1)]) as channel:
        grpc.channel_ready_future(channel).result(PATIENCE_S)
        yield SimlogAPIStub(channel), SimlogV2Stub(channel)  # type: ignore[no-untyped-call]


def inject(stub: Any, target: str, shadow: str) -> Any:
    topics = {"target": v1.TopicDescriptor(path=target), "injected": v1.TopicDescriptor(path=shadow)}
    stream = stub.Inject(v1.InjectRequest(**topics), timeout=PATIENCE_S)
    stream.initial_metadata()
    return stream


def publish(stub: Any, path: str, text: str) -> None:
    data = v1.ROSMessage(type="double", value=text)
    stub.Publish(iter([v1.PubRequest(topic=v1.TopicDescriptor(path=path), data=data)]), timeout=PATIENCE_S)


def write(stub: Any, path: str, number: float) -> None:
    data = v2.SimlogMessage(type=v2.NUMBER, value=Value(number_value=number))
    stub.Write(v2.PubRequest(topic=path, data=data), timeout=PATIENCE_S)


def present_injections(local: Attachment) -> int:
    return len(local.injections())


def test_version_1_on_in_and_on_out_of_a_memory(cell: Cell, local: Attachment) -> None:
    with client(cell) as (stub, _), client(cell) as (other, _):
        watching = other.Subscribe(v1.TopicDescriptor(path=f"{POSITION}/out"), timeout=PATIENCE_S)
        assert next(watching).value == "0.0"
        originals = inject(stub, f"{POSITION}/in", f"{POSITION}/shadow")
        publish(other, f"{POSITION}/in", "1.0E-4")
        first = next(originals)
        assert (first.value, first.type, first.timeStamp.stamp.nsec > 0) == ("0.0001", "double", True)
        publish(stub, f"{POSITION}/shadow", "2.5")
        assert next(watching).value == "2.5"
        originals.cancel()
        until(lambda: present_injections(local) == 0, "lifted")
        publish(other, f"{POSITION}/in", "3.5")
        assert next(watching).value == "3.5"

        originals = inject(stub, f"SIM://{POSITION}/out", f"/{POSITION}/shadow")
        assert next(originals).value == "3.5"
        publish(stub, f"{POSITION}/shadow", "-0.0")
        assert next(watching).value == "-0.0"
        publish(other, POSITION, "4.5")
        assert next(originals).value == "4.5"
        originals.cancel()
        assert next(watching).value == "4.5", "the same subscription continues"


def test_version_2_toward_an_emulated_controller(cell: Cell, local: Attachment) -> None:
    with client(cell) as (_, stub), client(cell) as (_, other):
        stream = stub.CreateSubscriber(v2.Subscriber(name="injector", uuid="1"), timeout=PATIENCE_S)
        stream.initial_metadata()
        answer = stub.Inject(v2.InjectRequest(targetPath=f"{PLACE}/in", shadowPathPrefix="shadow"), timeout=PATIENCE_S)
        write(stub, answer.shadowPathIn, 7)
        until(lambda: local[PLACE] == 7, "the device has the injected value")
        stub.Subscribe(v2.SubscriptionRequest(path=answer.shadowPathOut, subscriberUUID="1"), timeout=PATIENCE_S)
        write(other, f"CELL://{PLACE.removeprefix('cell/')}/in", 9)
        original = next(stream)
        assert (original.header.path, original.value.number_value) == (answer.shadowPathOut, 9)
        assert local[PLACE] == 7
        stream.cancel()
        until(lambda: present_injections(local) == 0, "lifted")
        write(other, f"{PLACE}/in", 9)
        until(lambda: local[PLACE] == 9, "a write reaches the device again")


CLIENT = """
import sys, grpc
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub
address, target = sys.argv[1:]
channel = grpc.insecure_channel(address)
topics = dict(target=v1.TopicDescriptor(path=target), injected=v1.TopicDescriptor(path="killed"))
stream = SimlogAPIStub(channel).Inject(v1.InjectRequest(**topics))
stream.initial_metadata()
SimlogV2Stub(channel).Inject(v2.InjectRequest(targetPath=target, shadowPathPrefix="killed"))
print("laid", flush=True)
sys.stdin.read()
"""


def test_injections_end_with_a_killed_client_or_endpoint(cell: Cell, local: Attachment) -> None:
    command = [sys.executable, "-c", CLIENT, str(cell.grpc), "cell/Robot_800/Axs1_Pos"]
    for victim in ("client", "grpc"):
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as injecting:
            assert injecting.stdout is not None
            assert injecting.stdout.readline() == "laid\n"
            assert present_injections(local) == 2
            before = local.read("cell/Robot_800/Axs1_Pos")
            assert before.provenance == "injected"
            if victim == "client":
                os.kill(injecting.pid, signal.SIGKILL)
            else:
                kill(cell.processes()["grpc"]["pid"])
            until(lambda: present_injections(local) == 0, "lifted")
            injecting.kill()
        until(lambda: cell.processes()["grpc"]["state"] == "running", "the endpoint is back")
        with client(cell) as (stub, _):
            assert local.read("cell/Robot_800/Axs1_Pos").provenance == "live"
            stub.GetTopic(v1.TopicDescriptor(path=PLACE), timeout=PATIENCE_S)
            assert present_injections(local) == 0


def newest(local: Attachment) -> Frame:
    frame = local.block("cell").latest()
    assert frame is not None
    return frame


def test_injections_of_clients_survive_a_killed_source_process(cell: Cell, local: Attachment) -> None:
    with client(cell) as (stub, _):
        originals = inject(stub, f"{PLACE}/in", "s")
        before = newest(local)
        kill(cell.processes()["cell"]["pid"])
        until(lambda: newest(local).incarnation > before.incarnation, "frames of another process")
        until(lambda: newest(local).quality.name == "GOOD", "good again")
        publish(stub, PLACE, "5")
        assert next(originals).value == "5"
        publish(stub, "s", "6")
        until(lambda: local[PLACE] == 6, "the device has the injected value")
        originals.cancel()
        until(lambda: present_injections(local) == 0, "lifted")


def test_a_source_that_is_not_armed_is_named_in_the_refusal(cell: Cell) -> None:
    until(lambda: cell.processes()["unarmed"]["quality"] == "good", "good quality")
    place = "unarmed/Outputs/100"
    with client(cell) as (stub, other):
        with pytest.raises(grpc.RpcError) as refused:
            next(inject(stub, f"{place}/in", "s"))
        assert refused.value.code() is grpc.StatusCode.FAILED_PRECONDITION
        reason = str(refused.value.details())
        assert f"{place}/in" in reason
        assert "needs `armed = true`" in reason
        with pytest.raises(grpc.RpcError) as refused:
            other.Inject(v2.InjectRequest(targetPath=f"{place}/in", shadowPathPrefix="p"), timeout=PATIENCE_S)
        assert refused.value.code() is grpc.StatusCode.FAILED_PRECONDITION


def test_lift_all_lifts_the_injections_of_clients(cell: Cell, local: Attachment) -> None:
    with client(cell) as (stub, other):
        originals = inject(stub, f"{PLACE}/in", "s")
        other.Inject(v2.InjectRequest(targetPath=POSITION, shadowPathPrefix="p"), timeout=PATIENCE_S)
        lifted = cell.run("shmio", "inject", "--lift-all")
        assert (lifted.returncode, len(lifted.stdout.splitlines())) == (0, 2)
        with pytest.raises(grpc.RpcError) as ended:
            next(originals)
        assert ended.value.code() is grpc.StatusCode.ABORTED
        assert present_injections(local) == 0
