"""Bits and slices of a cell's bytes: read, written and injected by every interface."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import grpc
import pytest
from google.protobuf.struct_pb2 import ListValue, Value

import shmio
from shmio.client import connect
from shmio.local.attach import Attachment
from shmio.testing.cell import PATIENCE_S, Cell, until
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub
from tests.system.armed import ARMED


@pytest.fixture(scope="module")
def cell(make_shared_cell: Callable[..., Cell]) -> Cell:
    """Start the A50 cell. Each test uses other bytes, from 100 on, which the PLC's program ignores."""
    cell = make_shared_cell(config=ARMED.replace('["Outputs"]', '["Outputs[*]"]'))
    cell.up()
    until(lambda: cell.processes()["cell"]["quality"] == "good", "good quality")
    return cell


@pytest.fixture
def local(cell: Cell) -> Iterator[Attachment]:
    with shmio.attach(cell.instance, writable=True) as local:
        yield local


@contextmanager
def client(cell: Cell) -> Iterator[tuple[Any, Any]]:
    with grpc.insecure_channel(str(cell.grpc), [("grpc.use_local_subchannel_pool", 1)]) as channel:
        grpc.channel_ready_future(channel).result(PATIENCE_S)
        yield SimlogAPIStub(channel), SimlogV2Stub(channel)  # type: ignore[no-untyped-call]


def lines(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def test_commands_accept_bits_and_slices(cell: Cell, local: Attachment) -> None:
    assert local.write({"cell/Outputs/100": 0b1010_0101, "cell/Outputs/101": 7})[0].done
    done = cell.run("shmio", "set", "cell/Outputs/100.%X1", "true", "cell/Outputs/100.%X7", "false")
    assert (done.returncode, done.stderr) == (0, "")
    assert lines(done.stdout) == ["cell/Outputs/100.%X1 written", "cell/Outputs/100.%X7 written"]
    until(lambda: local["cell/Outputs/100"] == 0b0010_0111, "the other bits are unchanged")

    done = cell.run("shmio", "set", "--json", "cell/Outputs/102..104", "[1, 2, 3]")
    assert json.loads(done.stdout) == {"cell/Outputs/102..104": {"outcome": "written", "reason": ""}}
    until(lambda: local["cell/Outputs/101..105"] == [7, 1, 2, 3, 0], "the frame after the write")
    assert local["cell/Outputs/100.%X5"] is True

    done = cell.run("shmio", "get", "cell/Outputs/100.%X5", "cell/Outputs/100.%X7", "cell/Outputs/103..104")
    assert lines(done.stdout) == [
        "cell/Outputs/100.%X5 true", "cell/Outputs/100.%X7 false", "cell/Outputs/103 2", "cell/Outputs/104 3",
    ]  # fmt: skip
    done = cell.run("shmio", "get", "cell.Outputs[103]", '"cell"."Outputs"[100].%x5')
    assert lines(done.stdout) == ["cell/Outputs/103 2", "cell/Outputs/100.%X5 true"]
    done = cell.run("shmio", "set", "Outputs[105].%X0", "1")
    assert lines(done.stdout) == ["cell/Outputs/105.%X0 written"]
    for path, message in [
        ("cell/Outputs/100.%X8", "BYTE has bits 0 to 7"),
        ("cell/Robot_800/Axs1_Pos.%X0", "REAL has no such part"),
        ("cell/Outputs/1099..1100", "outside"),
    ]:
        done = cell.run("shmio", "set", path, "1")
        assert (done.returncode, done.stdout) == (1, "")
        assert message in done.stderr


def test_simlog_version_1(cell: Cell, local: Attachment) -> None:
    bit, part = "cell/Outputs/110.%X3", "cell/Outputs/111..113"
    with client(cell) as (stub, _):
        assert stub.GetTopic(v1.TopicDescriptor(path=bit), timeout=PATIENCE_S).msgType == "bool"
        bits = stub.Subscribe(v1.TopicDescriptor(path=bit), timeout=PATIENCE_S)
        parts = stub.Subscribe(v1.TopicDescriptor(path=part), timeout=PATIENCE_S)
        assert [next(bits).value, next(parts).value] == ["false", "[0,0,0]"]
        assert local.write({"cell/Outputs/110": 0xF0})[0].done  # the bit is unchanged, so nothing is sent
        messages = [(bit, "bool", "true"), (part, "string", "[4, 5, 6]")]
        stub.Publish(
            iter(
                v1.PubRequest(topic=v1.TopicDescriptor(path=path), data=v1.ROSMessage(type=kind, value=value))
                for path, kind, value in messages
            ),
            timeout=PATIENCE_S,
        )
        assert [next(bits).value, next(parts).value] == ["true", "[4,5,6]"]
    until(lambda: local["cell/Outputs/110..114"] == [0xF8, 4, 5, 6, 0], "the frame after the write")


def test_simlog_version_2_with_injection_of_a_bit(cell: Cell, local: Attachment) -> None:
    bit, part = "cell/Outputs/120.%X3", "cell/Outputs/121..122"
    with client(cell) as (_, stub):
        stream = stub.CreateSubscriber(v2.Subscriber(name="s", uuid="bits"), timeout=PATIENCE_S)
        stream.initial_metadata()
        for path in (bit, part):
            stub.Subscribe(v2.SubscriptionRequest(path=path, subscriberUUID="bits"), timeout=PATIENCE_S)
        first = {message.header.path: message for message in (next(stream), next(stream))}
        assert (first[bit].type, first[part].type) == (v2.BOOL, v2.LIST)

        def write(path: str, **value: Any) -> None:
            stub.Write(
                v2.PubRequest(topic=path, data=v2.SimlogMessage(type=v2.BOOL, value=Value(**value))), timeout=PATIENCE_S
            )

        write("cell/Outputs/120", number_value=0xF0)
        write(bit, bool_value=True)
        assert next(stream).value.bool_value
        numbers = ListValue(values=[Value(number_value=4), Value(number_value=5)])
        write(part, list_value=numbers)
        assert next(stream).value.list_value == numbers
        until(lambda: local["cell/Outputs/120..123"] == [0xF8, 4, 5, 0], "neighbours are untouched")

        answer = stub.Inject(v2.InjectRequest(targetPath=f"{bit}/out", shadowPathPrefix="fake"), timeout=PATIENCE_S)
        write(answer.shadowPathIn, bool_value=False)
        assert not next(stream).value.bool_value
        write("cell/Outputs/120", number_value=0x0F)
        until(lambda: local["cell/Outputs/120"] == 0x07, "writes of the other bits")
        stream.cancel()


def test_shmio_v1(cell: Cell, local: Attachment) -> None:
    with connect(str(cell.grpc)) as remote:
        assert local.write({"cell/Outputs/130": 0x81})[0].done
        values = {"cell/Outputs/130.%X1": True, "cell/Outputs/130.%X7": False, "cell/Outputs/131..132": [8, 9]}
        assert [outcome.kind for outcome in remote.write(values)] == ["written"] * 3
        until(lambda: local["cell/Outputs/132"] == 9, "the frame after the write")
        read = remote.read("cell/Outputs/130.%X1", "cell/Outputs/130.%X7", "cell/Outputs/131..132")
        assert [(path, read[path]) for path in read] == [
            ("cell/Outputs/130.%X1", True),
            ("cell/Outputs/130.%X7", False),
            ("cell/Outputs/131", 8),
            ("cell/Outputs/132", 9),
        ]
        with remote.subscribe("cell/Outputs/130.%X2") as updates, remote.inject("cell/Outputs/130.%X2") as shadow:
            assert not next(updates)["cell/Outputs/130.%X2"]
            shadow.set({"cell/Outputs/130.%X2": True})
            assert next(update for update in updates if update["cell/Outputs/130.%X2"])
            assert local["cell/Outputs/130"] == 0x07
        assert local["cell/Outputs/129..133"] == [0, 0x03, 8, 9, 0]


def test_an_injection_on_in_intercepts_one_bit(cell: Cell, local: Attachment) -> None:
    with local.inject("cell/Outputs/140.%X2/in") as shadow:
        assert local.write({"cell/Outputs/140": 0xFF})[0].done
        until(lambda: local["cell/Outputs/140"] == 0xFB, "all but the bit")
        shadow.set({"cell/Outputs/140.%X2": True})
        until(lambda: local["cell/Outputs/140"] == 0xFF, "the injected bit")
        assert next(shadow.diverted(PATIENCE_S)).values == {"Outputs/140.%X2": True}


def test_hundreds_of_bits_in_one_command(cell: Cell, local: Attachment) -> None:
    values = {f"cell/Outputs/{byte}.%X{bit}": bool((byte ^ bit) & 1) for byte in range(200, 280) for bit in range(8)}
    with connect(str(cell.grpc)) as remote:
        assert {str(outcome.kind) for outcome in remote.write(values)} == {"written"}
    until(
        lambda: local["cell/Outputs/199..202"] == [0, 0b10101010, 0b01010101, 0b10101010], "the frame after the write"
    )
