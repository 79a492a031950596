"""Simulate over real sockets: with the generated code only, and by the Python clients."""

from __future__ import annotations

import asyncio
import gc
import logging
import threading
from collections.abc import Callable
from typing import Any

import grpc
import numpy as np
import pytest

from shmio.client import Client, Simulation, connect, connect_aio
from shmio.client.model import Values
from shmio.endpoints.grpc.time import stepper
from shmio.errors import CommandError, ConflictError, LostError, PathError, RemoteError, ShmioError, ValueRangeError
from shmio.messages import value_to_wire
from shmio.segment import Quality, Segment
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.client.both import BOTH, Connect
from tests.unit.connectors.models.test_stepped import Running
from tests.unit.endpoints import http2
from tests.unit.endpoints.grpc.shmio_v1.harness import stub, values
from tests.unit.endpoints.grpc.shmio_v1.remote import remote_segment, serve_remote, shown, source, spec
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, endpoint, refusal

Status = grpc.StatusCode
Request = wire.SimulateRequest


class Raw:
    """A model that sends and reads the messages of shmio.v1 itself."""

    def __init__(self, served: Endpoint) -> None:
        self.call = stub(served).Simulate(timeout=TIMEOUT_S)

    async def join(self, source: str = "drive", name: str = "raw") -> Any:
        await self.call.write(Request(join=wire.Join(source=source, name=name)))
        self.joined = (await self.read()).joined
        return self.joined

    async def read(self) -> Any:
        found = await asyncio.wait_for(self.call.read(), TIMEOUT_S)
        assert found is not grpc.aio.EOF
        return found

    async def work(self) -> Any:
        """Return the next step."""
        found = await self.read()
        assert found.WhichOneof("what") == "work"
        return found.work

    def inputs(self, work: Any) -> dict[str, Any]:
        return values(self.joined.inputs.registers, work.values)

    async def done(self, step: int, **given: Any) -> None:
        await self.call.write(Request(done=wire.Done(step=step, **given)))


def assigned(**given: Any) -> list[wire.Assignment]:
    return [wire.Assignment(path=path, value=value_to_wire(value, path)) for path, value in given.items()]


def stepping(served: Endpoint, count: int = 1) -> asyncio.Task[Any]:
    """Start this many steps in a task."""

    async def steps() -> Any:
        for _ in range(count):
            clock = await stub(served).Step(wire.StepRequest(dt_ns=20_000_000), timeout=TIMEOUT_S)
        return clock

    return asyncio.create_task(steps())


async def read(served: Endpoint, pattern: str = "drive") -> dict[str, Any]:
    found = await stub(served).Read(wire.ReadRequest(patterns=[pattern]), timeout=TIMEOUT_S)
    return values(found.tables[0].registers, found.updates[0].values)


# ---- on the wire -----------------------------------------------------------------------------------------------------


def test_a_model_gets_tables_and_values_then_its_steps(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        model = Raw(served)
        joined = await model.join()
        assert [register.path for register in joined.inputs.registers] == ["target", "speed", "label", "when", "lamps"]
        assert [register.path for register in joined.outputs.registers] == [
            "axis/position", "axis/moving", "axis/ready", "axis/count", "axis/name", "row", "lamps",
        ]  # fmt: skip
        assert (joined.computed, joined.clock.virtual, joined.period_ns) == (False, True, 20_000_000)
        present = values(joined.outputs.registers, joined.values)
        assert (present["axis/position"], present["row"]) == (0.25, [0] * 6)
        await shown(drive, Quality.GOOD)

        task = stepping(served, 3)
        work = await model.work()
        assert (work.step, work.time_ns, work.dt_ns, work.doubt) == (1, 20_000_000, 20_000_000, "")
        inputs = model.inputs(work)
        assert (inputs["target"], inputs["speed"], inputs["label"], inputs["lamps"]) == (1.5, 0, "", [False] * 10)
        bools = wire.Bools(values=[True, False, *[True] * 10])
        await model.done(1, values=wire.Values(doubles=wire.Doubles(values=[7.5]), bools=bools))
        work = await model.work()
        assert (work.step, model.inputs(work)) == (2, {}), "only changed inputs"
        ints = wire.Int32s(slots=[0, 2], values=[5, -3])
        await model.done(
            2, values=wire.Values(int32s=ints), assignments=assigned(**{"drive/axis/name": "x1", "row/2/2": 9})
        )
        assert (await model.work()).step == 3
        await model.done(3)
        assert (await task).step == 3
        found = await read(served)
        assert (found["axis/position"], found["axis/moving"], found["axis/ready"]) == (7.5, True, False)
        assert (found["axis/count"], found["row"], found["axis/name"]) == (5, [0, -3, 0, 0, 0, 9], "x1")
        assert found["lamps"] == [True] * 10, "the in-out register's new value"
        await model.call.done_writing()
        await shown(drive, Quality.BAD)
        assert await model.call.read() is grpc.aio.EOF

    serve_remote(instance, test)


def test_writes_reach_the_model_as_inputs(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        model = Raw(served)
        await model.join()
        task = stepping(served)
        assert list((await model.work()).invalid.registers) == []
        await model.done(1)
        await task
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            await cell.write({"drive/speed": -3, "drive/lamps/4": True}, until_accepted=True)
        task = stepping(served)
        assert model.inputs(await model.work()) == {"speed": -3, "lamps": {4: True}}
        await model.done(2)
        await task
        assert (await read(served))["lamps"] == [False] * 10
        model.call.cancel()

    serve_remote(instance, test)


def test_a_rejoining_model_gets_the_last_values(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        model = Raw(served)
        await model.join()
        task = stepping(served)
        await model.done((await model.work()).step, assignments=assigned(**{"axis/position": 3.5}))
        await task
        model.call.cancel()
        await shown(drive, Quality.BAD)
        again = Raw(served)
        joined = await again.join()
        assert joined.computed
        assert values(joined.outputs.registers, joined.values)["axis/position"] == 3.5
        task = stepping(served)
        work = await again.work()
        assert (work.step, again.inputs(work)["target"]) == (2, 1.5), "the first step has all inputs"
        await again.done(2)
        await task
        assert (await read(served))["axis/position"] == 3.5
        again.call.cancel()

    serve_remote(instance, test)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"failure": "no\n solution\x1b[2J"}, "model 'raw': no solution\\x1b[2J"),
        ({"failure": ""}, "model 'raw': it failed without giving a reason"),
        ({"assignments": assigned(**{"axis/count": 70_000})}, "model 'raw': axis/count: "),
        ({"assignments": assigned(target=1.0)}, "target: this is not an output of drive"),
        ({"assignments": assigned(**{"axis/coumt": 1})}, "did you mean 'axis/count'"),
        ({"assignments": assigned(**{"lamps/in": [True] * 10})}, "lamps/in: this is not an output"),
        ({"values": wire.Values(doubles=wire.Doubles(slots=[7], values=[1.0]))}, "doubles: the table has no slot 7"),
        ({"values": wire.Values(doubles=wire.Doubles(values=[1.0, 2.0]))}, "doubles: 2 values are given for 1 slots"),
        (
            {"values": wire.Values(doubles=wire.Doubles(slots=[0, 0], values=[1, 2]))},
            "doubles: 2 values are given, but the table has 1",
        ),
        ({"assignments": assigned(**{"axis/count": 1}) * 22}, "assignments: 22 values are given, but the table has 21"),
        ({"values": wire.Values(floats=wire.Floats(slots=[0], values=[1.0]))}, "floats: the table has no slot 0"),
    ],
)
def test_an_invalid_answer_fails_its_step_and_the_next_step_works(instance: str, given: Any, reason: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        model = Raw(served)
        await model.join()
        task = stepping(served)
        await model.work()
        await model.done(1, **given)
        code, text = await refusal(task)
        assert (code, reason in text) == (Status.FAILED_PRECONDITION, True), text
        task = stepping(served)
        refused = (await model.work()).refused
        assert refused == "" if "failure" in given else refused.startswith("step 1: "), refused
        await model.done(2, assignments=assigned(**{"axis/count": 2}))
        await task
        assert (await read(served))["axis/count"] == 2
        model.call.cancel()

    serve_remote(instance, test)


def test_outputs_that_come_too_late_are_shown_with_the_next_step(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        model = Raw(served)
        await model.join()
        task = stepping(served)
        await model.work()
        code, text = await refusal(task)
        assert (code, "did not answer within 200 ms" in text) == (Status.FAILED_PRECONDITION, True), text
        code, text = await refusal(stepping(served))
        assert "did not answer within 200 ms" in text, "it is still computing the first step"
        await model.done(1, assignments=assigned(**{"axis/count": 1}))
        number = 2
        link = served.segment.blocks["drive"].model_channel
        assert link is not None
        while True:  # a busy host may need several attempts
            number += 1
            task = stepping(served)
            work = await model.work()
            assert number > 3 or not link.answered.head(), "the endpoint does not pass a late answer to the source"
            assert work.step == number, "the model gets only steps with a waiting caller"
            assert number > 3 or "step 1: the answer came " in work.refused
            await model.done(number)
            try:
                await task
            except grpc.aio.AioRpcError:
                continue
            break
        assert (await read(served))["axis/count"] == 1
        model.call.cancel()

    serve_remote(instance, test, timeout_ms=200)


@pytest.mark.parametrize(
    ("requests", "code", "text"),
    [
        ([Request(done=wire.Done(step=1))], Status.INVALID_ARGUMENT, "the first message of Simulate must join"),
        ([Request()], Status.INVALID_ARGUMENT, "the first message of Simulate must join"),
        ([], Status.INVALID_ARGUMENT, "the first message of Simulate must join"),
        (
            [Request(join=wire.Join(source="nothing"))],
            Status.NOT_FOUND,
            "unknown source 'nothing'; valid: drive, cell",
        ),
        ([Request(join=wire.Join(source="cell"))], Status.FAILED_PRECONDITION, "sources that a model can join: drive"),
        ([Request(join=wire.Join(source="drive", name="x" * 104))], Status.INVALID_ARGUMENT, "name: at most 103 bytes"),
        ([Request(join=wire.Join(source="drive"))] * 2, Status.INVALID_ARGUMENT, "only the first message joins"),
        (
            [Request(join=wire.Join(source="drive")), Request(done=wire.Done(step=4))],
            Status.INVALID_ARGUMENT,
            "the model answered step 4, but no step is pending",
        ),
    ],
)
def test_calls_that_are_not_a_models_are_refused(instance: str, requests: list[Any], code: Status, text: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        async def converse() -> None:
            call = stub(served).Simulate(timeout=TIMEOUT_S)
            for request in requests:
                await call.write(request)
            if not requests:
                await call.done_writing()
            while await call.read() is not grpc.aio.EOF:
                pass

        found, told = await refusal(converse())
        assert (found, text in told) == (code, True), told
        await Raw(served).join()  # no trace of it remains

    serve_remote(instance, test)


def test_an_answer_to_another_step_ends_the_stream(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        model = Raw(served)
        await model.join()
        task = stepping(served)
        await model.work()
        await model.done(9)
        code, text = await refusal(model.work())
        assert (code, text) == (Status.INVALID_ARGUMENT, "the model answered step 9, but step 1 is pending")
        _, text = await refusal(task)
        assert "model 'raw' disconnected before it answered" in text

    serve_remote(instance, test)


def test_a_model_that_ends_without_reading_frees_its_source(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        deaf = await http2.Connection.open(served.port, deaf=True)
        await deaf.send(http2.headers("/shmio.v1.Shmio/Simulate"))
        joining = http2.message(Request(join=wire.Join(source="drive")).SerializeToString())
        await deaf.send(http2.frame(http2.DATA, 0, 1, joining))
        await shown(drive, Quality.GOOD)
        await deaf.send(http2.frame(http2.DATA, http2.END_STREAM, 1, b""))
        await asyncio.wait_for(shown(drive, Quality.BAD), TIMEOUT_S)
        await Raw(served).join()
        await deaf.drop(reset=True)

    serve_remote(instance, test)


def test_a_second_model_is_refused_and_the_first_named(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        await Raw(served).join(name="first")
        code, text = await refusal(Raw(served).join(name="second"))
        assert code is Status.ALREADY_EXISTS
        assert text.startswith("drive: model 'first' (ipv4:127.0.0.1:")

    serve_remote(instance, test)


def test_a_source_that_another_process_computes_is_refused(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        with Segment.open(served.segment.instance, writable=True) as other:
            link = other.blocks["drive"].model_channel
            assert link is not None
            assert link.join("local")
            code, text = await refusal(Raw(served).join())
            assert (code, "model 'local' (pid " in text) == (Status.ALREADY_EXISTS, True)
            link.leave()
        await Raw(served).join()

    serve_remote(instance, test)


def test_a_reload_ends_a_model_which_may_join_the_new_block(instance: str) -> None:
    async def run(segment: Segment) -> None:
        async with endpoint(segment) as served:
            model = Raw(served)
            await model.join()
            segment.change(add=[spec("drive", 10_000_000)], retire=["drive"])
            served.service.on_sources_replaced(["drive"])
            code, text = await refusal(model.read())
            assert (code, text) == (Status.UNAVAILABLE, "drive: a reload changed or removed this source; join again")

    with remote_segment(instance) as segment:
        asyncio.run(run(segment))


def test_an_endpoint_that_stops_during_a_step_releases_control_once(
    instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stepper, "REST_S", 0.02)

    async def test(served: Endpoint, drive: Running) -> None:
        wrong: list[dict[str, Any]] = []
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: wrong.append(context))
        model = Raw(served)
        await model.join()
        step = asyncio.create_task(served.service.stepper.step(20_000_000))
        await model.work()
        await served.service.stepper.stop()
        with pytest.raises(asyncio.CancelledError):
            await step
        rested = asyncio.Event()
        loop.call_later(5 * stepper.REST_S, rested.set)  # longer than the stepper waits before it releases control
        await rested.wait()
        gc.collect()
        assert wrong == []
        model.call.cancel()

    serve_remote(instance, test)


# ---- the clients -----------------------------------------------------------------------------------------------------


def with_client(instance: str, test: Callable[[Client, Running], None], **options: Any) -> None:
    async def run(served: Endpoint, drive: Running) -> None:
        def call() -> None:
            with connect(f"127.0.0.1:{served.port}", timeout_s=TIMEOUT_S) as cell:
                test(cell, drive)

        await asyncio.to_thread(call)

    serve_remote(instance, run, **options)


class Serving:
    """A model in a thread, run by ``simulate`` until it is closed."""

    def __init__(self, address: str, step: Any, **options: Any) -> None:
        self.joined = threading.Event()
        self.simulations: list[Simulation] = []
        self.error: ShmioError | None = None
        self._cell = connect(address)
        self._options = {"name": "served", "start": self._start, **options}
        self._thread = threading.Thread(target=self._run, args=(step,))
        self._thread.start()

    def _start(self, simulation: Simulation) -> None:
        self.simulations.append(simulation)
        self.joined.set()

    def _run(self, step: Any) -> None:
        try:
            self._cell.simulate("drive", step, **self._options)
        except ShmioError as error:
            self.error = error
        self.joined.set()

    def __enter__(self) -> Serving:
        assert self.joined.wait(TIMEOUT_S)
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._cell.close()
        self._thread.join()


def seen(cell: Client, quality: str) -> None:
    """Wait until the source has this quality."""
    while str(cell.read("drive").of("drive/speed").quality) != quality:
        pass


def test_a_function_computes_a_source(instance: str) -> None:
    def test(cell: Client, drive: Running) -> None:
        calls: list[tuple[float, float, Any, tuple[str, ...]]] = []

        def step(time_s: float, dt_s: float, inputs: Values) -> dict[str, object]:
            calls.append((time_s, dt_s, inputs["target"], inputs.changed))
            return {
                "axis/position": time_s * inputs["target"],
                "drive/axis/moving": np.bool_(True),
                "axis/count": 3.0,
                "axis/name": "abc",
                "row": np.arange(6).reshape(2, 3),
                "lamps": [False] * 9 + [True],
            }

        with Serving(cell.target.address, step) as serving:
            seen(cell, "good")
            cell.step(0.5)
            cell.write({"drive/target": 2.5}, until_accepted=True)
            cell.step(0.25)
            found = cell.read("drive")
            assert [found[f"drive/axis/{name}"] for name in ("position", "moving", "ready", "count", "name")] == [
                1.875, True, False, 3, "abc",
            ]  # fmt: skip
            np.testing.assert_array_equal(found["drive/row"], [[0, 1, 2], [3, 4, 5]])
            assert found["drive/lamps"].tolist() == [False] * 9 + [True]
            (simulation,) = serving.simulations
            assert (simulation.source, simulation.computed, simulation.period_s) == ("drive", False, 0.02)
            assert set(simulation.inputs) == {"target", "speed", "label", "when", "lamps"}
            assert (simulation.outputs["axis/position"], simulation.clock.virtual) == (0.25, True)
        assert calls == [
            (0.5, 0.5, 1.5, ("target", "speed", "label", "when", "lamps")),
            (0.75, 0.25, 2.5, ("target",)),
        ]
        assert serving.error is None
        with pytest.raises(CommandError, match="no model is connected"):
            cell.step()

    with_client(instance, test)


@pytest.mark.parametrize(
    ("outputs", "reason"),
    [
        ({"axis/none": 1}, "unknown output 'axis/none' of drive; did you mean 'axis/name'?"),
        ({"target": 1.0}, "unknown output 'target' of drive"),
        ({"axis/count": 1.5}, "axis/count: expected INT, found 1.5"),
        ({"axis/position": "far"}, "axis/position: expected LREAL, found 'far'"),
        ({"axis/name": 3}, "axis/name: expected STRING"),
        ({"axis/count": 1 << 40}, "axis/count: expected INT"),
        ({"axis/count": 70_000}, "axis/count: "),
        ({"row": [1, 2, 3]}, "row: expected 2 times 3 elements, found 3"),
        ({"row": [[1], [2, 3]]}, "row: expected 2 times 3 elements"),
        ({"row": 5}, "row: expected 2 times 3 elements, found no"),
        (7, "step returned 7, but must return a mapping from the paths of outputs to their values, or None"),
    ],
)
def test_invalid_outputs_fail_the_step(
    instance: str, outputs: Any, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    def test(cell: Client, drive: Running) -> None:
        good = threading.Event()
        with Serving(cell.target.address, lambda *_: {"axis/count": 1} if good.is_set() else outputs):
            with caplog.at_level(logging.WARNING, "shmio.client"):
                for _ in range(2):
                    with pytest.raises(CommandError) as caught:
                        cell.step()
            assert reason in str(caught.value)
            if outputs != {"axis/count": 70_000}:  # the endpoint finds this error itself
                told = [record.getMessage() for record in caplog.records if record.name == "shmio.client"]
                assert [text.startswith("drive: step 1 failed: ") for text in told] == [True], "reported once"
            good.set()
            cell.step()
            assert cell["drive/axis/count"] == 1
            if outputs == {"axis/count": 70_000}:
                last = [record.getMessage() for record in caplog.records if record.name == "shmio.client"][-1]
                assert last.startswith("drive: step 2: axis/count: "), "the next step reports it"

    with_client(instance, test)


def test_an_exception_in_the_model_fails_the_step_and_names_the_line(instance: str) -> None:
    def test(cell: Client, drive: Running) -> None:
        def step(time_s: float, dt_s: float, inputs: Values) -> None:
            if dt_s > 1:
                raise ZeroDivisionError("too far\nat once")

        with Serving(cell.target.address, step):
            cell.step(1.0)
            with pytest.raises(
                CommandError,
                match=r"drive: model 'served': ZeroDivisionError: too far at once \(test_simulate.py, line \d+\)$",
            ):
                cell.step(2.0)
            cell.step(1.0)

    with_client(instance, test)


@BOTH
def test_a_simulation_answers_steps_one_at_a_time(instance: str, connects: Connect) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        async with connects(f"127.0.0.1:{served.port}") as cell, await cell.simulation("drive") as simulation:
            with pytest.raises(RemoteError, match="there is no step to answer"):
                await simulation.done({})
            task = asyncio.create_task(cell.step(0.5))
            work = await anext(simulation)
            assert (work.step, work.time_ns, work.dt_ns) == (1, 500_000_000, 500_000_000)
            assert (work.time_s, work.dt_s, work.doubt) == (0.5, 0.5, "")
            for wrong, error in (({"nothing": 1}, PathError), ({"axis/count": 1.5}, ValueRangeError)):
                with pytest.raises(error):
                    await simulation.done(wrong)
            await simulation.done({"axis/count": work.step})
            await task
            assert await cell["drive/axis/count"] == 1
            task = asyncio.create_task(cell.step())
            await anext(simulation)
            await simulation.fail("no solution")
            with pytest.raises(CommandError, match="no solution"):
                await task
            with pytest.raises(RemoteError, match="there is no step to answer"):
                await simulation.fail("twice")
            simulation.close()
            assert [work async for work in simulation] == []
            async with await cell.simulation("drive") as again:
                assert (again.computed, again.outputs["axis/count"]) == (True, 1)

    serve_remote(instance, test)


@BOTH
def test_invalid_joins_are_refused(instance: str, connects: Connect) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        async with connects(f"127.0.0.1:{served.port}") as cell:
            with pytest.raises(PathError, match="unknown source 'x'"):
                await cell.simulate("x", lambda *_: None)
            with pytest.raises(CommandError, match="no model can join it"):
                await cell.simulate("cell", lambda *_: None)
            async with await cell.simulation("drive", "first"):
                with pytest.raises(ConflictError, match="model 'first'"):
                    await cell.simulate("drive", lambda *_: None)
            with pytest.raises(ValueRangeError, match="name: at most 103 bytes"):
                await cell.simulation("drive", "x" * 200)

    serve_remote(instance, test)


@BOTH
def test_simulate_ends_when_its_client_is_closed(instance: str, connects: Connect) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        joined = threading.Event()
        async with connects(f"127.0.0.1:{served.port}") as cell:
            task = asyncio.create_task(cell.simulate("drive", lambda *_: None, start=lambda _: joined.set()))
            assert await asyncio.to_thread(joined.wait, TIMEOUT_S)
        await task
        await shown(drive, Quality.BAD)

    serve_remote(instance, test)


def test_simulate_waits_for_an_absent_instance_for_a_limited_time() -> None:
    with connect("127.0.0.1:1") as cell, pytest.raises(LostError, match="no instance serves there"):
        cell.simulate("drive", lambda *_: None, patience_s=0.3)


def test_simulate_rejoins_a_restarted_endpoint_and_sends_all_outputs(instance: str) -> None:
    """The endpoint closes its port, and another endpoint opens it."""
    with remote_segment(instance) as segment, Running(segment, "drive", source()) as drive:

        def step(time_s: float, dt_s: float, inputs: Values) -> dict[str, object]:
            first = "target" in inputs.changed and time_s < 1
            return {"axis/count": 7, "axis/name": "kept"} if first else {"axis/count": 8}

        async def first() -> tuple[Serving, int]:
            async with endpoint(segment) as served:
                serving = await asyncio.to_thread(Serving, f"127.0.0.1:{served.port}", step, patience_s=TIMEOUT_S)
                await asyncio.to_thread(serving.joined.wait, TIMEOUT_S)
                await stepping(served)
                serving.joined.clear()
                return serving, served.port

        async def second(port: int, serving: Serving) -> None:
            async with endpoint(segment, port=port) as served:
                assert await asyncio.to_thread(serving.joined.wait, TIMEOUT_S)
                await shown(drive, Quality.GOOD)
                await stub(served).Step(wire.StepRequest(dt_ns=2_000_000_000), timeout=TIMEOUT_S)
                found = await read(served)
                assert (found["axis/count"], found["axis/name"]) == (8, "kept")
                assert [one.computed for one in serving.simulations] == [False, True]

        serving, port = asyncio.run(first())
        try:
            asyncio.run(second(port, serving))
        finally:
            serving.close()


def test_a_coroutine_function_computes_a_source_until_it_is_cancelled(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        async def step(time_s: float, dt_s: float, inputs: Values) -> dict[str, object]:
            await asyncio.sleep(0)
            if dt_s > 1:
                raise ValueError("too far")
            return {"axis/count": round(time_s * 100)}

        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            joined = asyncio.Event()
            task = asyncio.create_task(cell.simulate("drive", step, name="aio", start=lambda _: joined.set()))
            await asyncio.wait_for(joined.wait(), TIMEOUT_S)
            await cell.step(0.5)
            assert (await cell.read("drive"))["drive/axis/count"] == 50
            with pytest.raises(CommandError, match=r"model 'aio': ValueError: too far \(test_simulate.py, line "):
                await cell.step(2.0)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            await shown(drive, Quality.BAD)

    serve_remote(instance, test)


def test_in_real_time_the_model_steps_once_a_period(instance: str) -> None:
    def test(cell: Client, drive: Running) -> None:
        with Serving(cell.target.address, lambda time_s, dt_s, _: {"axis/position": time_s}):
            shown_at = 0.0
            for update in cell.subscribe("drive/axis/position", every_frame=True):
                if str(update.quality) == "good" and update.cycle > 0:
                    now = float(update["axis/position"])
                    assert now in (pytest.approx(update.cycle * 0.02), 0.25)
                    if now > shown_at > 0.25:
                        break
                    shown_at = max(now, shown_at)

    with_client(instance, test, virtual=False)
