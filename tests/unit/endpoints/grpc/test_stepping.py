"""Time controlled by clients: what streams receive of a step, and when the step's call returns."""

from __future__ import annotations

import asyncio
import os
from typing import Any

import grpc
import pytest
from google.protobuf.empty_pb2 import Empty

from shmio.endpoints.grpc.streams.outbox import StateLane
from shmio.endpoints.grpc.time import delivery, stepper
from shmio.endpoints.grpc.time.timeline import TimeStatus
from shmio.errors import TimeError
from shmio.local.time_control import Coordinator
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as ours
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as sim
from shmio.wire.shmio_v1_pb2_grpc import ShmioStub
from tests.unit.endpoints import http2
from tests.unit.endpoints.grpc.services.test_simlog_v2 import write
from tests.unit.endpoints.grpc.services.test_simlog_v2_subscribers import messages
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, endpoint, image, listening, message, refusal, serve
from tests.unit.endpoints.stepped import Model, simulate, stepped_segment

Status = grpc.StatusCode
Models = dict[str, Model]
MS = 1_000_000
GOAL = v1.TopicDescriptor(path="sim/goal/in")


async def step(served: Endpoint) -> int:
    """Step by version 1; return the answer's code."""
    answer = await served.stub.step(v1.StepRequest(), timeout=TIMEOUT_S)
    return int(answer.code)


async def open_v1(served: Endpoint, path: str) -> Any:
    stream = served.subscribe(path)
    await stream.initial_metadata()
    return stream


async def values(stream: Any, count: int) -> list[str]:
    return [(await asyncio.wait_for(stream.read(), TIMEOUT_S)).value for _ in range(count)]


def prefixed(request: v1.PubRequest) -> bytes:
    return http2.message(request.SerializeToString())


async def drained(stream: Any) -> None:
    """Read the stream to its end."""
    while await asyncio.wait_for(stream.read(), TIMEOUT_S) is not grpc.aio.EOF:
        pass


def test_version_1_steps_by_the_size_that_was_set(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        clock, count = await open_v1(served, "/model/clock"), await open_v1(served, "sim/count/out")
        await served.stub.setStepSize(v1.StepSizeRequest(step=20), timeout=TIMEOUT_S)
        assert [await step(served) for _ in range(3)] == [0, 0, 0]
        told = [await asyncio.wait_for(clock.read(), TIMEOUT_S) for _ in range(4)]
        stamps = [(one.timeStamp.stamp.sec, one.timeStamp.stamp.nsec) for one in told]
        assert stamps == [(0, 0), (0, 20 * MS), (0, 40 * MS), (0, 60 * MS)]
        assert {(one.type, one.value, one.WhichOneof("content")) for one in told} == {("time", "", "timeStamp")}
        got = [await asyncio.wait_for(count.read(), TIMEOUT_S) for _ in range(4)]
        assert [one.value for one in got] == ["0", "1", "2", "3"]
        assert [one.timeStamp.stamp.nsec for one in got] == [0, 20 * MS, 40 * MS, 60 * MS]
        assert [one.timeStamp.seq for one in got] == [0, 1, 2, 3]

    simulate(instance, test)


def test_a_step_is_50_ms_by_default_and_is_reported_in_nanoseconds(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        assert await step(served) == 0
        assert served.segment.clock.read().time_ns == 50 * MS
        await served.stub.setStepSize(v1.StepSizeRequest(step=1500), timeout=TIMEOUT_S)
        await step(served)
        clock = await open_v1(served, "model/clock")
        stamp = (await asyncio.wait_for(clock.read(), TIMEOUT_S)).timeStamp.stamp
        assert (stamp.sec, stamp.nsec) == (1, 1550 * MS)
        for wrong in (0, -1, 3_600_001):
            request = v1.StepSizeRequest(step=wrong)
            status, text = await refusal(served.stub.setStepSize(request, timeout=TIMEOUT_S))
            assert (status, "the length of a step must be from 0.001 ms to 3600000 ms" in text) == (
                Status.INVALID_ARGUMENT,
                True,
            )

    simulate(instance, test)


def test_every_value_of_a_step_comes_before_its_one_marker(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        paths = ["SIM://doubled/out", "SIM://count", "b/count", "SIMLOG://step", "sim/row/2"]
        stream = await served.subscriber("one", *paths)
        assert await messages(stream, 4) == [
            ("SIM://doubled/out", 0.0),
            ("SIM://count", 0.0),
            ("b/count", 0.0),
            ("sim/row/2", 0.0),
        ]
        for number in range(1, 4):
            status = await served.time.step(sim.StepRequest(), timeout=TIMEOUT_S)
            assert (status.clock, status.deltaTime, status.alive, status.playing) == (50 * number, 50, True, False)
            assert await messages(stream, 5) == [  # in the order of the blocks, not of the subscriptions
                ("SIM://count", number),
                ("SIM://doubled/out", 2 * number),
                ("sim/row/2", number + 1),
                ("b/count", number),
                ("SIMLOG://step", number),
            ]

    simulate(instance, test, "sim", "b")


def test_all_streams_have_received_a_step_when_its_call_returns(instance: str) -> None:
    """Messages sent before the answer arrive before it, because they share a connection."""

    async def test(served: Endpoint, models: Models) -> None:
        streams = [await served.subscriber(str(n), "sim/count", "SIMLOG://step") for n in range(5)]
        old = await open_v1(served, "sim/doubled")
        await step(served)
        assert all(outbox._taken == outbox._next for outbox in served.service._outboxes._open)
        for stream in streams:
            assert await messages(stream, 3) == [("sim/count", 0.0), ("sim/count", 1.0), ("SIMLOG://step", 1.0)]
        assert await values(old, 2) == ["0", "2"]

    simulate(instance, test)


def test_a_marker_comes_only_with_each_step(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream, old = await served.subscriber("one", "SIMLOG://step"), await open_v1(served, "SIMLOG://step")
        for _ in range(3):
            await step(served)
        late = await served.subscriber("two", "SIMLOG://step")
        await step(served)
        assert await messages(stream, 4) == [("SIMLOG://step", float(n)) for n in (1, 2, 3, 4)]
        assert await messages(late, 1) == [("SIMLOG://step", 4.0)]
        got = [await asyncio.wait_for(old.read(), TIMEOUT_S) for _ in range(4)]
        assert [(one.type, one.value, one.timeStamp.stamp.nsec) for one in got] == [
            ("int", str(n), n * 50 * MS) for n in (1, 2, 3, 4)
        ]

    simulate(instance, test)


def test_the_topics_for_time_have_a_type_but_cannot_be_read(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        for path, kind in (("SIMLOG://step", "int"), ("/model/clock", "time")):
            topic = await served.stub.GetTopic(v1.TopicDescriptor(path=path), timeout=TIMEOUT_S)
            assert topic == v1.TopicDescriptor(path=path, msgType=kind)
            info = await served.v2.GetTopicInfo(v2.TopicInfoRequest(path=path), timeout=TIMEOUT_S)
            assert info == v2.TopicInfo(path=path, type=v2.NUMBER, direction=v2.OUT, exists=True)
            status, text = await refusal(served.v2.Read(v2.ReadRequest(path=[path]), timeout=TIMEOUT_S))
            assert (status, text) == (Status.NOT_FOUND, f"{path}: clients can only subscribe to this topic")
        stream = await served.subscriber("one", "model/clock")
        await served.time.step(sim.StepRequest(deltaTime=250), timeout=TIMEOUT_S)
        assert await messages(stream, 2) == [("model/clock", 0.0), ("model/clock", 0.25)]

    simulate(instance, test)


def test_a_step_applies_the_writes_before_it_and_their_echo_comes_first(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "sim/goal", "sim/reached", "SIM://goal/in", "SIMLOG://step")
        for number in range(1, 20):
            await write(served, "SIM://goal/in", number)
            await served.time.step(sim.StepRequest(), timeout=TIMEOUT_S)
        expected: list[tuple[str, float]] = [("sim/goal", 0.0), ("sim/reached", 0.0)]
        for number in range(1, 20):
            expected += [("SIM://goal/in", number), ("sim/goal", number)]
            expected += [("sim/reached", number - 1)] if number > 1 else []
            expected.append(("SIMLOG://step", number))
        assert await messages(stream, len(expected)) == expected

    simulate(instance, test)


def test_version_1_publishes_values_between_steps(instance: str) -> None:
    """The client waits until its values have arrived, because gRPC does not order two calls."""

    async def test(served: Endpoint, models: Models) -> None:
        goal, write_subscriptions = await open_v1(served, "sim/goal"), await open_v1(served, "sim/goal/in")
        publish: Any = served.stub.Publish(timeout=TIMEOUT_S)
        expected, published = ["0"], []
        for number in range(1, 40):
            for repeated in range(number % 7 + 1):
                value = str(100 * number + repeated)
                await publish.write(v1.PubRequest(topic=GOAL, data=v1.ROSMessage(type="double", value=value)))
                arrived = await asyncio.wait_for(write_subscriptions.read(), TIMEOUT_S)
                published.append((arrived.value == value, arrived.timeStamp.seq))
            assert await step(served) == 0
            expected.append(value)
        assert await values(goal, len(expected)) == expected
        assert published == [(True, number - 1) for number in range(1, 40) for _ in range(number % 7 + 1)]
        await publish.done_writing()
        await publish

    simulate(instance, test)


def test_a_step_applies_values_that_arrive_in_one_packet_with_it(instance: str) -> None:
    """Values and step follow each other on the wire, but the endpoint reads them in two calls."""

    async def test(served: Endpoint, models: Models) -> None:
        goal = await open_v1(served, "sim/goal")
        client = await http2.Connection.open(served.port)
        await client.send(http2.headers("/simulation.server.SimlogAPI/Publish"))
        expected = ["0"]
        for number in range(1, 100):
            expected.append(str(10 * number + number % 9))
            values_of_step = [str(10 * number + i) for i in range(number % 9 + 1)]
            await client.send(
                b"".join(
                    http2.frame(http2.DATA, 0, 1, prefixed(v1.PubRequest(topic=GOAL, data=v1.ROSMessage(value=value))))
                    for value in values_of_step
                )
                + http2.call("/simulation.server.SimlogAPI/step", b"", 2 * number + 1)
            )
            await client.until_end(2 * number + 1)
        assert await values(goal, len(expected)) == expected
        await client.drop(reset=True)

    simulate(instance, test)


def test_a_failed_step_gives_a_negative_code_or_a_status_and_the_next_works(
    instance: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "sim/count", "SIMLOG://step")
        models["sim"].failure = "out of memory"
        assert await step(served) == -1
        status, text = await refusal(served.time.step(sim.StepRequest(), timeout=TIMEOUT_S))
        assert (status, text) == (Status.FAILED_PRECONDITION, "step 2: sim: out of memory")
        assert "a step failed: step 1: sim: out of memory" in caplog.text
        models["sim"].failure = ""
        assert await step(served) == 0
        assert await messages(stream, 3) == [("sim/count", 0.0), ("sim/count", 3.0), ("SIMLOG://step", 3.0)]

    simulate(instance, test)


def test_steps_are_refused_while_another_program_controls_time(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        with Segment.open(instance, writable=True) as other:
            local = Coordinator(other)
            await asyncio.to_thread(local.step)
            for call in (
                served.time.step(sim.StepRequest(), timeout=TIMEOUT_S),
                served.time.start(sim.StartRequest(), timeout=TIMEOUT_S),
                served.time.pause(Empty(), timeout=TIMEOUT_S),
                served.stub.setStepSize(v1.StepSizeRequest(step=20), timeout=TIMEOUT_S),
            ):
                status, text = await refusal(call)
                assert (status, "is moved by" in text) == (Status.FAILED_PRECONDITION, True)
            assert await step(served) == -1
            local.close()
            assert await step(served) == 0

    simulate(instance, test)


def test_steps_of_another_program_are_delivered_and_acknowledged(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "sim/count", "SIMLOG://step")
        statuses = served.time.subscribe(Empty(), timeout=TIMEOUT_S)
        await statuses.initial_metadata()
        slot = served.segment.processes.find("grpc")
        slot.take()
        with Segment.open(instance, writable=True) as other:
            local = Coordinator(other)
            for number in range(1, 30):
                await asyncio.to_thread(local.step)
                assert served.segment.clock.delivered(slot.index) == number
            local.close()
        await step(served)
        got = await messages(stream, 61)
        assert got == [("sim/count", 0.0)] + [
            pair for n in range(1, 31) for pair in (("sim/count", float(n)), ("SIMLOG://step", float(n)))
        ]
        assert [(await asyncio.wait_for(statuses.read(), TIMEOUT_S)).clock for _ in range(30)] == [
            50 * n for n in range(1, 31)
        ]

    simulate(instance, test)


def test_the_last_step_of_a_program_that_ended_comes_before_the_first_step_of_a_client(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "sim/count", "SIMLOG://step")
        with Segment.open(instance, writable=True) as other:
            local = Coordinator(other)
            local.step()  # blocks the event loop, which notices nothing before the client's step
            local.close()
            await served.service.stepper.step()
        assert await messages(stream, 5) == [
            ("sim/count", 0.0),
            *(pair for n in (1.0, 2.0) for pair in (("sim/count", n), ("SIMLOG://step", n))),
        ]

    simulate(instance, test)


def test_real_time_between_two_steps_has_no_marker(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "SIMLOG://step")
        with Segment.open(instance, writable=True) as other:
            local = Coordinator(other)
            numbers = [(await asyncio.to_thread(local.step)).number]
            assert await message(stream) == ("SIMLOG://step", numbers[0])
            local.release()  # the event loop does not run in real time
            models["sim"].publish(numbers[0] + 100)
            local.take_over()
            assert local.read().done == numbers[0] + 100
            served.service.stepper.timeline.update()
            numbers.append((await asyncio.to_thread(local.step)).number)
            assert await message(stream) == ("SIMLOG://step", numbers[1])
            local.close()

    simulate(instance, test, virtual=False)


def test_another_program_may_step_faster_than_the_endpoint_follows(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        timeline, told = served.service.stepper.timeline, list[int]()
        with Segment.open(instance, writable=True) as other:
            local = Coordinator(other)

            def watch(status: TimeStatus) -> None:
                told.append(status.clock_ns)
                if len(told) < 500:
                    local.step()

            async def seen() -> bool:
                return len(told) == 500

            timeline.watch(watch)
            local.step()
            timeline.update()
            await served.until(seen)
            assert told == [50 * MS * n for n in range(1, 501)]
            local.close()

    simulate(instance, test)


def test_time_is_neither_given_up_nor_released_while_a_step_is_delivered(
    instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise streams of shmio.v1 would send later values with the step."""
    monkeypatch.setattr(stepper, "REST_S", 0.01)

    async def test(served: Endpoint, models: Models) -> None:
        moving, clock = served.service.stepper, served.segment.clock

        async def idle() -> bool:
            return moving._rest is None

        async def asked() -> bool:
            return clock.read().done > 0

        with served.service._outboxes.opened() as outbox:  # of a client that takes nothing
            StateLane(outbox).keep(b"value")
            call = served.time.step(sim.StepRequest(), timeout=TIMEOUT_S)
            await served.until(asked)
            call.cancel()
            await served.until(idle)
            await asyncio.sleep(0)
            with Segment.open(instance, writable=True) as other, pytest.raises(TimeError, match="is moved by"):
                Coordinator(other).take_over()
            released = asyncio.create_task(moving.release())
            for _ in range(10):
                await asyncio.sleep(0)
            assert clock.read().virtual
        await released
        assert not clock.read().virtual

    simulate(instance, test, virtual=False)


def test_a_local_step_waits_for_the_endpoint_only_while_it_has_streams(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        slot = served.segment.processes.find("grpc")
        slot.take()

        async def left() -> bool:
            return served.segment.clock.delivered(slot.index) is None

        with Segment.open(instance, writable=True) as other:
            local = Coordinator(other)
            for _ in range(3):
                local.step()  # blocks the event loop, which notices nothing meanwhile
            stream = await served.subscriber("one", "sim/count", "SIMLOG://step")
            assert await messages(stream, 1) == [("sim/count", 3.0)], "the client sees the finished step"
            await asyncio.to_thread(local.step)
            assert served.segment.clock.delivered(slot.index) == 4
            assert await messages(stream, 2) == [("sim/count", 4.0), ("SIMLOG://step", 4.0)]
            stream.cancel()
            await served.until(left)
            local.step()
            assert served.service.stepper.timeline.status.clock_ns == 5 * 50_000_000
            local.close()

    simulate(instance, test)


def test_a_first_step_that_ends_before_the_endpoint_looks_is_delivered(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "sim/count", "SIMLOG://step")
        slot = served.segment.processes.find("grpc")
        slot.take()
        with Segment.open(instance, writable=True) as other:
            local = Coordinator(other)
            stepping = asyncio.create_task(asyncio.to_thread(local.step))
            await asyncio.sleep(0)  # lets the thread start
            clock = served.segment.clock
            while not (state := clock.read()).dt_ns or state.stepping:  # blocks the event loop until the step is done
                clock.bell.wait(clock.bell.value(), 10_000_000)
            done = await stepping
            assert served.segment.clock.delivered(slot.index) == done.number
            local.close()
        got = await messages(stream, 3)
        assert got == [("sim/count", 0.0), ("sim/count", 1.0), ("SIMLOG://step", float(done.number))]

    simulate(instance, test, virtual=False)


def test_a_stream_that_is_not_read_ends_and_others_continue(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delivery, "PATIENCE_S", 2.0)

    async def test(served: Endpoint, models: Models) -> None:
        options = [
            ("grpc.http2.bdp_probe", 0),
            ("grpc.use_local_subchannel_pool", 1),
        ]  # limits a client's window to 64 KiB
        async with grpc.aio.insecure_channel(f"127.0.0.1:{served.port}", options=options) as channel:
            create: Any = channel.unary_stream("/simlog.server.SimlogAPI/CreateSubscriber")
            idle = create(v2.Subscriber(uuid="idle").SerializeToString(), timeout=TIMEOUT_S)
            await idle.initial_metadata()
            for path in ("sim/row", "/sim/row", "sim/row/out", "/sim/row/out", "SIM://row", "SIM://row/out"):
                await served.add("idle", path)
            reader = await served.subscriber("reader", "sim/count", "SIMLOG://step")
            number = 0
            while not any(outbox.failure for outbox in served.service._outboxes._open):
                assert await step(served) == 0
                number += 1
            for _ in range(3):
                assert await step(served) == 0
            number += 3
            expected = [pair for n in range(1, number + 1) for pair in (("sim/count", n), ("SIMLOG://step", n))]
            assert await messages(reader, 2 * number + 1) == [("sim/count", 0.0), *expected]
            status, text = await refusal(drained(idle))
            assert status is Status.RESOURCE_EXHAUSTED
            assert "has not taken the values of a step within 2 s" in text

    simulate(instance, test)


DEAF = {
    "v1": ("/simulation.server.SimlogAPI/Subscribe", v1.TopicDescriptor(path="sim/row").SerializeToString()),
    "shmio": ("/shmio.v1.Shmio/Subscribe", ours.SubscribeRequest(patterns=["sim/row"]).SerializeToString()),
}


@pytest.mark.parametrize("wire", DEAF)
def test_a_client_that_takes_nothing_delays_one_step_only(
    instance: str, monkeypatch: pytest.MonkeyPatch, wire: str
) -> None:
    def patience(for_s: float) -> None:
        monkeypatch.setattr(delivery, "PATIENCE_S", for_s)

    async def test(served: Endpoint, models: Models) -> None:
        patience(0.5)
        connection = await http2.Connection.open(served.port, deaf=True)
        await connection.send(http2.call(*DEAF[wire]))
        reader = await served.subscriber("reader", "sim/count")

        def given_up() -> bool:
            streams = served.service._shmio_v1.subscribe_calls._open
            return any(outbox.failure for outbox in served.service._outboxes._open) or any(one.late for one in streams)

        number = 0
        while not given_up():
            assert await step(served) == 0
            number += 1
        patience(3600)
        for _ in range(3):
            assert await step(served) == 0
        got = await messages(reader, number + 4)
        assert got == [("sim/count", float(n)) for n in range(number + 4)]
        assert {subject.path for subject in served.feeds["sim"]._channels} == {"count"}
        assert not any(one._blocks for one in served.service._shmio_v1.subscribe_calls._open)
        await connection.drop(reset=True)

    simulate(instance, test)


def test_a_running_step_completes_without_its_client(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "SIMLOG://step")
        models["sim"].mute = True
        call = served.time.step(sim.StepRequest(), timeout=TIMEOUT_S)

        async def asked() -> bool:
            return served.segment.clock.read().step == 1

        await served.until(asked)
        call.cancel()
        models["sim"].answer()
        assert await message(stream) == ("SIMLOG://step", 1.0)
        assert await step(served) == 0
        assert await message(stream) == ("SIMLOG://step", 2.0)

    simulate(instance, test)


def test_a_queued_step_is_dropped_without_its_client(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        models["sim"].mute = True
        first = served.time.step(sim.StepRequest(), timeout=TIMEOUT_S)
        clock = served.segment.clock

        async def open_calls(count: int) -> None:
            async def there() -> bool:
                await asyncio.sleep(0)
                return clock.read().step == 1 and len(served.server.calls) == count

            await served.until(there)

        await open_calls(1)
        others = [served.time.step(sim.StepRequest(), timeout=TIMEOUT_S) for _ in range(5)]
        await open_calls(6)
        for call in others:
            call.cancel()
        await open_calls(1)
        models["sim"].answer()
        await first
        assert await step(served) == 0
        assert clock.read().step == 2

    simulate(instance, test)


def test_start_after_a_pause_that_waits_for_a_step_plays(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "SIMLOG://step")
        await served.time.start(sim.StartRequest(deltaTime=5), timeout=TIMEOUT_S)
        await messages(stream, 1)
        models["sim"].mute = True
        clock = served.segment.clock

        async def held_up() -> bool:
            await asyncio.sleep(0)
            return clock.read().stepping and len(served.server.calls) == calls

        calls = 1
        await served.until(held_up)
        pause = served.time.pause(Empty(), timeout=TIMEOUT_S)
        calls = 2
        await served.until(held_up)
        start = served.time.start(sim.StartRequest(deltaTime=5), timeout=TIMEOUT_S)
        calls = 3
        await served.until(held_up)
        models["sim"].answer()
        assert not (await pause).playing
        assert (await start).playing
        assert clock.read().playing
        assert not (await served.time.pause(Empty(), timeout=TIMEOUT_S)).playing
        assert await step(served) == 0

    simulate(instance, test)


@pytest.mark.parametrize("ours", [True, False])
def test_an_endpoint_continues_the_playing_of_its_predecessor_only(instance: str, ours: bool) -> None:
    with stepped_segment(instance, "sim") as segment:
        with Segment.open(instance, writable=True) as dying:  # without releasing control of time
            Coordinator(dying).set_playing(True)
        model = Model(segment, "sim")

        async def run() -> None:
            async with endpoint(segment, before=os.getpid() if ours else os.getpid() + 1) as served:
                if ours:
                    stream = await served.subscriber("one", "SIMLOG://step")
                    await messages(stream, 2)
                    await served.time.pause(Empty(), timeout=TIMEOUT_S)
                assert await step(served) == 0, "no program plays time"

        try:
            asyncio.run(run())
        finally:
            model.stop()


def test_the_death_of_a_program_that_plays_is_reported(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        statuses = served.time.subscribe(Empty(), timeout=TIMEOUT_S)
        await statuses.initial_metadata()
        with Segment.open(instance, writable=True) as dying:  # without releasing control of time
            Coordinator(dying).set_playing(True)
            assert (await asyncio.wait_for(statuses.read(), TIMEOUT_S)).playing
        served.service.stepper.timeline.update()
        assert not (await asyncio.wait_for(statuses.read(), TIMEOUT_S)).playing
        assert await step(served) == 0, "any client may step again"

    simulate(instance, test)


def test_steps_of_several_clients_are_done_one_after_another(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "sim/count", "SIMLOG://step")
        codes = await asyncio.gather(*(step(served) for _ in range(20)))
        assert set(codes) == {0}
        assert (await messages(stream, 41))[1:] == [
            pair for n in range(1, 21) for pair in (("sim/count", float(n)), ("SIMLOG://step", float(n)))
        ]

    simulate(instance, test)


def test_play_steps_until_paused_and_the_status_shows_it(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        statuses = served.time.subscribe(Empty(), timeout=TIMEOUT_S)
        await statuses.initial_metadata()

        async def told() -> tuple[int, int, bool, bool]:
            got = await asyncio.wait_for(statuses.read(), TIMEOUT_S)
            return got.clock, got.deltaTime, got.alive, got.playing

        stream = await served.subscriber("one", "SIMLOG://step")
        started = await served.time.start(sim.StartRequest(deltaTime=5), timeout=TIMEOUT_S)
        assert (started.playing, started.alive, started.deltaTime) == (True, True, 5)
        assert await messages(stream, 3) == [("SIMLOG://step", float(n)) for n in (1, 2, 3)]
        status, text = await refusal(served.time.step(sim.StepRequest(), timeout=TIMEOUT_S))
        assert (status, "pause it" in text) == (Status.FAILED_PRECONDITION, True)
        paused = await served.time.pause(Empty(), timeout=TIMEOUT_S)
        assert (paused.playing, paused.alive) == (False, True)
        before = served.segment.clock.read().step
        assert await step(served) == 0
        assert served.segment.clock.read().step == before + 1
        stopped = await served.time.stop(Empty(), timeout=TIMEOUT_S)
        assert (stopped.playing, stopped.alive, stopped.exitCode) == (False, False, 0)
        assert await step(served) == 0
        assert await told() == (0, 5, True, True)
        for number in range(1, before + 1):
            assert await told() == (5 * number, 5, True, True)
        assert await told() == (5 * before, 50, True, False)
        assert await told() == (5 * before + 50, 50, True, False)
        assert await told() == (5 * before + 50, 50, False, False)
        assert await told() == (5 * before + 100, 50, True, False)

    simulate(instance, test)


def test_invalid_steps_are_refused(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        for call in (
            served.time.step(sim.StepRequest(deltaTime=-1), timeout=TIMEOUT_S),
            served.time.start(sim.StartRequest(deltaTime=3_600_001), timeout=TIMEOUT_S),
        ):
            status, text = await refusal(call)
            assert (status, "the length of a step must be from 0.001 ms to 3600000 ms" in text) == (
                Status.INVALID_ARGUMENT,
                True,
            )
        assert not served.segment.clock.read().playing

    simulate(instance, test)


def test_a_subscriber_that_joins_between_two_steps_gets_the_last_step_first(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        await step(served)
        models["sim"].image[11] = 7
        models["sim"].publish(1)  # as an injection would cause
        stream = await served.subscriber("one", "sim/goal", "sim/count", "SIMLOG://step")
        assert await messages(stream, 2) == [("sim/goal", 0.0), ("sim/count", 1.0)]
        await step(served)
        assert await messages(stream, 3) == [("sim/count", 2.0), ("sim/goal", 7.0), ("SIMLOG://step", 2.0)]

    simulate(instance, test)


def test_refused_calls_do_not_take_control_of_time(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        for call in (
            served.stub.setStepSize(v1.StepSizeRequest(step=-20), timeout=TIMEOUT_S),
            served.time.step(sim.StepRequest(deltaTime=-1), timeout=TIMEOUT_S),
            served.time.start(sim.StartRequest(deltaTime=-1), timeout=TIMEOUT_S),
        ):
            assert (await refusal(call))[0] is Status.INVALID_ARGUMENT
        assert not served.segment.clock.read().virtual

    simulate(instance, test, virtual=False)


def test_wall_time_runs_until_a_client_takes_control(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        clock = await open_v1(served, "model/clock")
        count = await open_v1(served, "sim/count")
        ticks = [(await asyncio.wait_for(clock.read(), TIMEOUT_S)).timeStamp.stamp.nsec for _ in range(3)]
        assert 0 < ticks[0] < ticks[1] < ticks[2]
        model = models["sim"]
        for number in range(1, 4):
            model.image[3] = number
            model.publish(number)
        assert await values(count, 4) == ["0", "1", "2", "3"]
        await served.time.pause(Empty(), timeout=TIMEOUT_S)
        at_ns = served.segment.clock.read().time_ns
        model.image[3] = 9
        model.publish(served.segment.clock.read().step)
        assert await step(served) == 0
        assert await values(count, 1) == ["10"]
        while (last := (await asyncio.wait_for(clock.read(), TIMEOUT_S)).timeStamp.stamp.nsec) <= at_ns:
            pass
        assert last == at_ns + 50 * MS

    simulate(instance, test, virtual=False)


def test_wake_ups_pause_between_steps_until_an_outcome_or_real_time_cannot_wait(
    instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.wakeups.PAUSE_S", 1000.0)

    async def test(served: Endpoint, models: Models) -> None:
        api: Any = ShmioStub(served.channel)  # type: ignore[no-untyped-call]
        (wake_up,) = served.wake_ups._wake_ups.values()
        updates = api.Subscribe(ours.SubscribeRequest(patterns=["sim/count"]), timeout=TIMEOUT_S)
        stream = await served.subscriber("one", "sim/count")
        await messages(stream, 1)

        async def paused() -> bool:
            assert await step(served) == 0
            await messages(stream, 1)
            return wake_up._pausing is not None

        for number in (1, 2):
            await served.until(paused)
            await write(served, "SIM://goal/in", number)
        await served.until(paused)
        await api.Release(ours.ReleaseRequest(), timeout=TIMEOUT_S)
        models["sim"].image[3] = 200
        models["sim"].publish(served.segment.clock.read().step + 1)
        assert await messages(stream, 1) == [("sim/count", 200.0)]
        async with asyncio.timeout(TIMEOUT_S):
            while not (answer := await updates.read()).updates or answer.updates[-1].cycle < models["sim"].writer.cycle:
                pass

    simulate(instance, test, virtual=False)


def test_frames_of_devices_are_not_held_back_for_a_step(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        stream = await served.subscriber("one", "cell/step", "SIMLOG://step")
        await step(served)
        served.publish(image(step=2))
        got = await messages(stream, 3)
        assert got[0] == ("cell/step", 1.0)
        assert got[2] == ("cell/step", 2.0)
        assert got[1][0] == "SIMLOG://step"

    serve(segment, test)


def test_a_stream_that_ends_during_a_step_does_not_delay_it(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        streams = [await served.subscriber(str(n), "sim/row", "sim/count") for n in range(20)]
        stepping = asyncio.ensure_future(step(served))
        for stream in streams:
            stream.cancel()
        assert await stepping == 0
        await served.until(lambda: listening(served, 0))
        assert await step(served) == 0

    simulate(instance, test)


def test_values_that_are_bad_after_a_step_are_sent_when_good_again(instance: str) -> None:
    async def test(served: Endpoint, models: Models) -> None:
        stream = await served.subscriber("one", "b/goal", "sim/goal", "SIMLOG://step")
        await messages(stream, 2)
        await step(served)
        assert await message(stream) == ("SIMLOG://step", 1.0)
        models["b"].failure = "lost"
        assert await step(served) == -1
        models["b"].failure = ""
        await step(served)
        assert await message(stream) == ("SIMLOG://step", 3.0)

    simulate(instance, test, "sim", "b")
