"""Steps of time by shmio.v1, and the updates that streams receive before the call returns."""

from __future__ import annotations

import asyncio
import threading
from contextlib import closing
from typing import Any

import grpc
import pytest

from shmio.client import connect_aio
from shmio.endpoints.grpc import wakeups
from shmio.endpoints.grpc.shmio_v1 import selection
from shmio.errors import CommandError, ValueRangeError
from shmio.local.time_control import Coordinator
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.endpoints.grpc.shmio_v1.harness import stub, subscribe, values
from tests.unit.endpoints.grpc.test_stepping import step as step_v1
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, refusal
from tests.unit.endpoints.stepped import Model, simulate

Models = dict[str, Model]
MS = 1_000_000


def step(served: Endpoint, dt_ms: int = 0) -> Any:
    return stub(served).Step(wire.StepRequest(dt_ns=dt_ms * MS), timeout=TIMEOUT_S)


async def next_message(call: Any) -> Any:
    found = await asyncio.wait_for(call.read(), TIMEOUT_S)
    assert found is not grpc.aio.EOF
    return found


@pytest.mark.parametrize("mode", [wire.MODE_LATEST, wire.MODE_EVERY_FRAME])
def test_streams_get_a_steps_changes_then_its_marker_before_the_call_returns(instance: str, mode: Any) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        call = subscribe(served, "sim/count", "other/doubled", mode=mode).call
        tables: dict[int, Any] = {}
        first = await next_message(call)
        tables |= {table.number: table for table in first.tables}
        while len(first.updates) < 2:
            first.MergeFrom(await next_message(call))
        for number in (1, 2, 3):
            clock = await step(served, 20)
            assert (clock.virtual, clock.step, clock.time_ns) == (True, number, number * 20 * MS)
            told: dict[str, Any] = {}
            over = False
            while not over:
                message = await next_message(call)
                for update in message.updates:
                    assert update.cycle == number
                    told |= values(tables[update.table].registers, update.values)
                over = message.HasField("step")
            assert told == {"count": number, "doubled": 2 * number}
            assert (message.step.number, message.step.time_ns) == (number, number * 20 * MS)
        await step_v1(served)  # a step by another client
        while not (message := await next_message(call)).HasField("step"):
            pass
        assert message.step.number == 4

    simulate(instance, test, "sim", "other")


def test_a_step_applies_the_writes_before_it(instance: str) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            assert (await cell.set_step_size(0.02)).step_size_ns == 20 * MS
            (outcome,) = await cell.write({"sim/goal": 7}, until_accepted=True)
            assert (outcome.kind, outcome.done) == ("accepted", True)
            assert (await cell.step()).time_ns == 20 * MS
            assert (await cell.read("sim"))["sim/goal"] == 7
            assert (await cell.step(0.5)).time_ns == 520 * MS
            assert (await cell.read("sim"))["sim/reached"] == 7
            status = await cell.status()
            assert status["clock"]["virtual"]
            with pytest.raises(ValueRangeError):
                await cell.step(4000)

    simulate(instance, test)


def test_watch_clock_hears_at_once_of_the_steps_of_another_program(
    instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While nobody waits for changes of time, the endpoint looks at the clock only from time to time."""
    monkeypatch.setattr(wakeups, "PAUSE_S", 1000.0)

    async def test(served: Endpoint, _: Models) -> None:
        with Segment.open(instance, writable=True) as segment, closing(Coordinator(segment)) as coordinator:
            await asyncio.to_thread(coordinator.step, MS)
            await asyncio.to_thread(coordinator.step, MS)
            watching = stub(served).WatchClock(wire.WatchClockRequest(), timeout=TIMEOUT_S)
            assert (await next_message(watching)).step == 2
            for number in (3, 4):
                await asyncio.to_thread(coordinator.step, MS)
                while (await next_message(watching)).step < number:
                    pass
            watching.cancel()

    simulate(instance, test)


def test_play_and_watch_clock(instance: str) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        watching = stub(served).WatchClock(wire.WatchClockRequest(), timeout=TIMEOUT_S)
        assert (await next_message(watching)).time_ns == 0
        clock = await stub(served).Play(wire.PlayRequest(dt_ns=5 * MS, rate=2.0), timeout=TIMEOUT_S)
        assert (clock.playing, clock.rate) == (True, 2.0)
        while (told := await next_message(watching)).step < 3:
            assert told.virtual
        assert not (await stub(served).Pause(wire.PauseRequest(), timeout=TIMEOUT_S)).playing
        code, _text = await refusal(stub(served).Play(wire.PlayRequest(rate=-1.0), timeout=TIMEOUT_S))
        assert code is grpc.StatusCode.INVALID_ARGUMENT
        code, _text = await refusal(stub(served).SetStepSize(wire.SetStepSizeRequest(), timeout=TIMEOUT_S))
        assert code is grpc.StatusCode.INVALID_ARGUMENT

    simulate(instance, test)


def test_after_a_release_frames_are_sent_without_a_step(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        call = subscribe(served, "sim/count").call
        clock = served.subscribe("/model/clock")
        old = served.subscribe("sim/count/out")
        first = await next_message(call)
        (table,) = first.tables
        await old.read()
        watching = stub(served).WatchClock(wire.WatchClockRequest(), timeout=TIMEOUT_S)
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            done = await cell.step(1800)
            while not (await next_message(call)).HasField("step"):
                pass
            models["sim"].image[0:4] = (7).to_bytes(4, "big")
            models["sim"].publish(
                done.step
            )  # a frame that would wait for a step, as after a write that is shown at once
            released = await cell.release()
            assert (released.virtual, released.time_ns >= done.time_ns) == (False, True)
            while (await next_message(watching)).virtual:
                pass
            for count in (7, 8):
                models["sim"].image[0:4] = count.to_bytes(4, "big")
                if count == 8:
                    models["sim"].publish(done.step + 1)
                message = await next_message(call)
                assert not message.HasField("step")
                assert [values(table.registers, update.values) for update in message.updates] == [{"count": count}]
            while (await asyncio.wait_for(old.read(), TIMEOUT_S)).value != "8":
                pass
            while (await asyncio.wait_for(clock.read(), TIMEOUT_S)).timeStamp.stamp.sec < 1800:
                pass
            told = [(await asyncio.wait_for(clock.read(), TIMEOUT_S)).timeStamp.stamp for _ in range(2)]
            assert all(stamp.sec >= 1800 for stamp in told), "the clock topic is sent again"
            assert (await cell.step()).step > done.step
            while not (message := await next_message(call)).HasField("step"):
                pass

    simulate(instance, test, virtual=False)


def test_time_that_started_virtual_cannot_be_released(instance: str) -> None:
    async def test(served: Endpoint, _: Models) -> None:
        code, text = await refusal(stub(served).Release(wire.ReleaseRequest(), timeout=TIMEOUT_S))
        assert (code, "always runs in virtual time" in text) == (grpc.StatusCode.FAILED_PRECONDITION, True)

    simulate(instance, test)


def test_a_failed_step_gives_the_reason(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        models["sim"].failure = "division by zero"
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            with pytest.raises(CommandError, match="division by zero"):
                await cell.step()

    simulate(instance, test)


def test_a_stream_that_is_slow_to_open_delays_no_step(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on = threading.Event(), threading.Event()
    select = selection._select

    def slow(*given: Any, **options: Any) -> Any:
        begun.set()
        assert go_on.wait(TIMEOUT_S)
        return select(*given, **options)

    monkeypatch.setattr(selection, "_select", slow)

    async def test(served: Endpoint, _: Models) -> None:
        opening = subscribe(served, "sim/count")
        first = asyncio.create_task(opening.values())
        assert await asyncio.to_thread(begun.wait, TIMEOUT_S)
        await step(served)
        assert not go_on.is_set()
        go_on.set()
        assert await first == {"count": 1}
        await step(served)
        assert await opening.values() == {"count": 2}

    simulate(instance, test)


def test_a_stream_that_is_not_read_is_ended_and_steps_continue(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.time.delivery.PATIENCE_S", 0.2)

    async def test(served: Endpoint, models: Models) -> None:
        async with grpc.aio.insecure_channel(
            f"127.0.0.1:{served.port}", [("grpc.http2.lookahead_bytes", 0), ("grpc.use_local_subchannel_pool", 1)]
        ) as channel:
            request = wire.SubscribeRequest(patterns=["sim"]).SerializeToString()
            raw: Any = channel.unary_stream("/shmio.v1.Shmio/Subscribe")
            silent = raw(request, timeout=TIMEOUT_S)
            await asyncio.wait_for(silent.read(), TIMEOUT_S)
            reading = subscribe(served, "sim/count")
            await reading.update()
            for number in range(1, 400):
                await step(served)
                assert (await reading.update()).cycle == number
            silent.cancel()
        assert models

    simulate(instance, test)
