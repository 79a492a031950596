"""Many steps in one call of shmio.v1."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import grpc
import pytest

from shmio.client import Stepped, connect_aio
from shmio.endpoints.grpc.shmio_v1 import clock
from shmio.errors import CommandError, ValueRangeError
from shmio.local.time_control import Step
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.client.both import BOTH, Connect
from tests.unit.endpoints.grpc.shmio_v1.harness import stub, subscribe
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint
from tests.unit.endpoints.stepped import Model, simulate

Models = dict[str, Model]
MS = 1_000_000


def target(served: Endpoint) -> str:
    return f"127.0.0.1:{served.port}"


def done(*numbers: int, dt_ms: int = 50) -> list[Stepped]:
    return [Stepped(number, number * dt_ms * MS) for number in numbers]


def test_all_requested_steps_are_done_and_streams_get_each_one(instance: str) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        stream = subscribe(served, "sim/count")
        assert await stream.values() == {"count": 0}
        async with connect_aio(target(served)) as cell:
            seen = []
            async for step in cell.steps(40, 0.02):
                seen.append(step)
                assert served.service.stepper.timeline.virtual_time.moment.number >= step.step
            assert seen == done(*range(1, 41), dt_ms=20)
            assert (await cell.clock()).step == 40
        assert [await stream.values() for _ in range(40)] == [{"count": number} for number in range(1, 41)]

    simulate(instance, test)


def test_a_step_applies_the_writes_since_the_previous_one(instance: str) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        async with connect_aio(target(served)) as cell, cell.steps() as stepping:
            for goal in (7, 8, 9):
                await cell.write({"sim/goal": goal}, until_accepted=True)
                await stepping.step()
                assert (await cell.read("sim"))["sim/goal"] == goal
            assert await stepping.step(0.02) == Stepped(4, 170 * MS)

    simulate(instance, test)


@BOTH
def test_steps_are_done_in_the_order_of_their_requests(instance: str, connects: Connect) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        async with connects(target(served)) as cell:
            assert [step async for step in cell.steps(3)] == done(1, 2, 3)
            assert [step async for step in cell.steps()] == []
            async with cell.steps(2) as stepping:
                assert await anext(stepping) == done(4)[0]
                assert await stepping.step() == done(6)[0], "after the steps requested earlier"
                assert await stepping.step() == done(7)[0]
                assert [step async for step in stepping] == []
            with pytest.raises(CommandError, match="closed"):
                await stepping.step()
            with pytest.raises(ValueRangeError, match=r"from 0\.001 ms to 3600000 ms"):
                cell.steps(1, 4000)
            with pytest.raises(ValueRangeError, match="-1 steps: from 0 to 4294967295"):
                cell.steps(-1)

    simulate(instance, test)


@BOTH
def test_a_failed_step_ends_the_call_and_the_rest_is_not_done(instance: str, connects: Connect) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        async with connects(target(served)) as cell:
            stepping = cell.steps()
            for _ in range(3):
                await stepping.step()
            models["sim"].failure = "division by zero"
            call = stub(served).Steps(timeout=TIMEOUT_S)
            await call.write(wire.StepsRequest(count=5))
            await call.write(wire.StepsRequest(count=5))
            assert await call.code() is grpc.StatusCode.FAILED_PRECONDITION
            assert "division by zero" in await call.details()
            assert (await cell.clock()).step == 3
            with pytest.raises(CommandError, match="step 5: sim: division by zero"):
                await stepping.step()
            assert [step async for step in stepping] == []
            models["sim"].failure = ""
            assert [step.step async for step in cell.steps(2)] == [6, 7]

    simulate(instance, test)


def test_a_failure_comes_after_the_answers_to_earlier_steps(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        call = stub(served).Steps(timeout=TIMEOUT_S)
        await call.write(wire.StepsRequest(count=2))
        await call.write(wire.StepsRequest(dt_ns=1 << 62))
        seen = [step.number async for message in _until_error(call) for step in message.steps]
        assert seen == [1, 2]
        assert await call.code() is grpc.StatusCode.INVALID_ARGUMENT

    simulate(instance, test)


async def _until_error(call: Any) -> AsyncIterator[Any]:
    try:
        async for message in call:
            yield message
    except grpc.RpcError:
        return


def test_closing_the_call_stops_its_steps_and_frees_time(instance: str) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        async with connect_aio(target(served)) as cell:
            stepping = cell.steps(1_000_000)
            assert [await anext(stepping) for _ in range(3)] == done(1, 2, 3)
            stepping.close()
            last = (await cell.step()).step
            async with asyncio.timeout(TIMEOUT_S):
                while (now := (await cell.step()).step) != last + 1:  # the other call steps, too, until it has ended
                    last = now

    simulate(instance, test)


def test_steps_are_refused_while_time_plays(instance: str) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        async with connect_aio(target(served)) as cell:
            await cell.play(dt_s=0.005)
            with pytest.raises(CommandError, match="playing"):
                await anext(cell.steps(3))
            await cell.pause()

    simulate(instance, test)


def test_steps_wait_while_the_client_does_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "MAX_ANSWERS", 5)

    class Stepper:
        made = 0

        async def step(self, dt_ns: int | None, peer: str) -> Step:
            assert (dt_ns, peer) == (None, "peer")
            await asyncio.sleep(0)
            self.made += 1
            return Step(self.made, self.made, 1)

    async def requests() -> AsyncIterator[Any]:
        yield wire.StepsRequest(count=100)

    async def test() -> None:
        stepper: Any = Stepper()
        messages = clock.StepsCall(stepper, "peer").messages(requests())
        sizes = []
        async for message in messages:
            sizes.append(len(wire.StepsResponse.FromString(message).steps))
            for _ in range(50):  # lets the event loop run
                await asyncio.sleep(0)
            assert stepper.made <= sum(sizes) + 5
        assert sum(sizes) == stepper.made == 100
        assert max(sizes) == 5

    asyncio.run(test())
