"""Write over real sockets: all or nothing, with an outcome for each value."""

from __future__ import annotations

import asyncio
import math
import struct
from typing import Any

import grpc
import pytest

from shmio.messages import value_to_wire
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.endpoints.grpc.services.test_publish import with_plant
from tests.unit.endpoints.grpc.shmio_v1.harness import stub
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, refusal
from tests.unit.endpoints.plant import Plant

Status = grpc.StatusCode
KINDS = wire.Outcome


def assignments(values: dict[str, Any]) -> list[wire.Assignment]:
    return [wire.Assignment(path=path, value=value_to_wire(value, path)) for path, value in values.items()]


def write(served: Endpoint, values: dict[str, Any], **options: Any) -> Any:
    return stub(served).Write(wire.WriteRequest(values=assignments(values), **options), timeout=TIMEOUT_S)


async def kinds(call: Any) -> list[int]:
    return [outcome.kind for outcome in (await call).outcomes]


def test_registers_arrays_and_elements_in_one_command(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        values = {
            "cell/axis/position": 1.5,
            "cell/running/in": True,
            "inputs/1": 7,
            "cell/step": -3.0,
            "cell/bits": [True] + [False] * 9,
            "CELL://name": "abc",
        }
        assert await kinds(write(served, values)) == [KINDS.KIND_WRITTEN] * 6
        memory = device.memory
        assert struct.unpack_from(">f", memory)[0] == 1.5
        assert bytes(memory[8:16]) == b"\x08\0\0\7\xff\xfd\1\0"
        assert memory[16:21] == b"\x08\x03abc"

    with_plant(segment, test)


def test_values_can_be_given_as_text(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        values = {"cell/step": "12", "cell/axis/speed": "1.0E-4", "cell/inputs": "[1, 2]", "cell/running": "true"}
        assert await kinds(write(served, values)) == [KINDS.KIND_WRITTEN] * 4
        assert device.memory[12:14] == b"\0\x0c"
        assert device.memory[10:12] == b"\1\2"

    with_plant(segment, test)


def test_a_refusal_by_the_device_is_an_outcome_with_its_reason(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.refusal = "address out of range"
        answer = await write(served, {"cell/step": 1, "cell/axis/position": 2})
        told = [(outcome.kind, outcome.reason) for outcome in answer.outcomes]
        assert told == [(KINDS.KIND_REFUSED, "address out of range")] * 2

    with_plant(segment, test)


def test_a_write_that_the_source_rejects_is_not_done_at_all(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.commands.close("not connected")
        answer = await write(served, {"cell/step": 1, "cell/axis/position": 2})
        assert [(one.kind, one.reason) for one in answer.outcomes] == [
            (KINDS.KIND_REJECTED, "the source is not connected: not connected")
        ] * 2
        assert not device.written

    with_plant(segment, test, running=False)


def test_write_can_return_once_the_values_are_accepted(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        assert await kinds(write(served, {"cell/step": 1}, until_accepted=True)) == [KINDS.KIND_ACCEPTED]
        assert not device.written
        await asyncio.to_thread(device.cycle)
        assert device.memory[13] == 1

    with_plant(segment, test, running=False)


def test_a_write_without_a_cycle_in_time_expires(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        answer = await write(served, {"cell/step": 1}, timeout_ms=50)
        assert [one.kind for one in answer.outcomes] == [KINDS.KIND_EXPIRED]
        assert not device.written

    with_plant(segment, test, running=False)


def test_each_of_many_writers_gets_its_own_outcomes(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        calls = [write(served, {"cell/inputs/0": i % 256, "cell/step": i}) for i in range(200)]
        for call in calls:
            assert set(await kinds(call)) <= {KINDS.KIND_WRITTEN, KINDS.KIND_EXPIRED}
        assert device.written

    with_plant(segment, test)


@pytest.mark.parametrize(
    ("values", "code", "message"),
    [
        ({}, Status.INVALID_ARGUMENT, "no value is given"),
        ({"cell/nothing": 1}, Status.NOT_FOUND, "no such register"),
        ({"cell/axis": 1}, Status.NOT_FOUND, "a structure"),
        ({"cell/step": 1, "cell/secret": 2}, Status.FAILED_PRECONDITION, "cell/secret is not writable"),
        ({"cell/step/out": 1}, Status.FAILED_PRECONDITION, "leave out /out"),
        ({"cell/step": 1, "cell/step/in": 2}, Status.INVALID_ARGUMENT, "given twice"),
        ({"cell/step": 40_000}, Status.INVALID_ARGUMENT, "cell/step"),
        ({"cell/step": 1.5}, Status.INVALID_ARGUMENT, "cell/step"),
        ({"cell/step": math.nan}, Status.INVALID_ARGUMENT, "cell/step"),
        ({"cell/step": [1]}, Status.INVALID_ARGUMENT, "cell/step"),
        ({"cell/step": (1 << 64) - 1}, Status.INVALID_ARGUMENT, "cell/step"),
        ({"cell/inputs": [1]}, Status.INVALID_ARGUMENT, "2 elements"),
        ({"cell/running": 2}, Status.INVALID_ARGUMENT, "BOOL"),
        ({"cell/name": "123456789"}, Status.INVALID_ARGUMENT, "at most 8 are allowed"),
        ({"cell/name": 5}, Status.INVALID_ARGUMENT, "cell/name"),
    ],
)
def test_invalid_values_are_refused_before_anything_is_sent(
    segment: Segment, values: dict[str, Any], code: Any, message: str
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        found, text = await refusal(write(served, values))
        assert found is code
        assert message in text
        assert not device.written

    with_plant(segment, test)


def test_missing_values_long_time_outs_and_deep_nesting_are_refused(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        bare = wire.WriteRequest(values=[wire.Assignment(path="cell/step")])
        assert (await refusal(stub(served).Write(bare, timeout=TIMEOUT_S)))[0] is Status.INVALID_ARGUMENT
        late = wire.WriteRequest(values=assignments({"cell/step": 1}), timeout_ms=1 << 31)
        assert "timeout_ms" in (await refusal(stub(served).Write(late, timeout=TIMEOUT_S)))[1]
        deep = value_to_wire([[[[[[[[1]]]]]]]], "x")
        nested = wire.WriteRequest(values=[wire.Assignment(path="cell/step", value=deep)])
        assert (await refusal(stub(served).Write(nested, timeout=TIMEOUT_S)))[0] is Status.INVALID_ARGUMENT

    with_plant(segment, test)


def test_too_many_values_are_refused_before_any_is_checked(segment: Segment) -> None:
    async def test(served: Endpoint, _: Plant) -> None:
        code, text = await refusal(write(served, {f"nothing/{number}": 1 for number in range(4097)}))
        assert (code, text.startswith("4097 values are given, but at most 4096")) == (Status.INVALID_ARGUMENT, True), (
            text
        )

    with_plant(segment, test)
