"""Inject of version 1, over real sockets: toward the device, and toward subscribers."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import grpc
import pytest

from shmio.config import Declaration
from shmio.local.writer import SourceWriter
from shmio.segment import Direction, Quality, Segment
from shmio.wire import simlog_v1_pb2 as wire
from tests.unit.endpoints.grpc.services.test_publish import counted, counts, message, with_plant
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, code, refusal, serve, value
from tests.unit.endpoints.plant import GUEST, Plant

Status = grpc.StatusCode
SHADOW = "axis/position/shadow"


def inject(served: Endpoint, target: str, shadow: str, **options: Any) -> Any:
    request = wire.InjectRequest(injected=wire.TopicDescriptor(path=shadow), target=wire.TopicDescriptor(path=target))
    return served.stub.Inject(request, **{"timeout": TIMEOUT_S, **options})


async def laid(served: Endpoint, target: str, shadow: str, **options: Any) -> Any:
    stream = inject(served, target, shadow, **options)
    await stream.initial_metadata()
    return stream


async def publish(served: Endpoint, *values: tuple[str, str]) -> None:
    await served.stub.Publish(iter([message(path, text) for path, text in values]), timeout=TIMEOUT_S)


def present_injections(served: Endpoint) -> list[tuple[str, str]]:
    return [(one.direction, one.name) for one in served.segment.blocks["cell"].injections.read()]


async def lifted(served: Endpoint) -> None:
    async def condition() -> bool:
        return not present_injections(served)

    await served.until(condition)


async def seen(stream: Any, wanted: str) -> None:
    while await value(stream) != wanted:
        pass


def test_on_in_the_device_gets_injected_values_and_the_injector_gets_writes(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        originals = await laid(served, "cell/step/in", "cell/step/shadow")
        await publish(served, ("cell/step/in", "7"), ("cell/step", "7"), ("cell/step/in", "9"))
        assert [await value(originals) for _ in range(3)] == ["7", "7", "9"]
        assert counted(served) == (3, 0), "the publisher does not notice"
        assert device.written == []
        await publish(served, ("cell/step/shadow", "8"))
        assert device.memory[12:14] == b"\0\x08"
        originals.cancel()
        await lifted(served)
        await publish(served, ("cell/step/in", "5"))
        assert device.memory[12:14] == b"\0\5"
        await publish(served, ("cell/step/shadow", "6"))
        assert counted(served) == (5, 1), "the shadow ends with its injection"

    with_plant(segment, test)


def test_on_out_consumers_get_injected_values_and_the_injector_gets_originals(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, ("cell/step", "3"))
        consumer = served.subscribe("cell/step")
        await seen(consumer, "3")
        originals = await laid(served, "cell/step/out", "cell/step/shadow")
        assert await value(originals) == "3", "the current value first"
        await publish(served, ("cell/step/shadow", "-1"))
        assert await value(consumer) == "-1"
        await publish(served, ("cell/step", "4"))
        first = await originals.read()
        assert (first.value, first.type) == ("4", "int")
        assert first.timeStamp.stamp.nsec > 0
        late = served.subscribe("cell/step/out")
        assert await value(late) == "-1"
        originals.cancel()
        assert await value(consumer) == "4"
        assert await value(late) == "4"
        await lifted(served)

    with_plant(segment, test)


def test_consumers_keep_the_last_value_until_the_injector_gives_one(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        await publish(served, ("cell/step", "3"))
        originals = await laid(served, "cell/step", "s")  # without a suffix it is on /out
        await publish(served, ("cell/step", "4"))
        await seen(originals, "4")
        assert await value(served.subscribe("cell/step")) == "3"
        originals.cancel()

    with_plant(segment, test)


def test_the_shadow_is_a_topic_while_the_injection_lasts(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        shadow = wire.TopicDescriptor(path=f"/{SHADOW}")
        assert await code(served.stub.GetTopic(shadow)) is Status.NOT_FOUND
        originals = await laid(served, "CELL://axis/position/in", SHADOW)
        info = await served.stub.GetTopic(shadow, timeout=TIMEOUT_S)
        assert (info.path, info.msgType) == (shadow.path, "double")
        watching = served.subscribe(f"CELL://{SHADOW}")
        await watching.initial_metadata()
        await publish(served, (SHADOW, "1.0E-4"), (f"cell/{SHADOW}", "2"))
        assert [await value(watching) for _ in range(2)] == ["0.0001", "2.0"]
        originals.cancel()
        status, text = await refusal(watching.read())
        assert status is Status.NOT_FOUND
        assert text == f"CELL://{SHADOW}: no client uses the injection any more"
        assert await code(served.stub.GetTopic(shadow)) is Status.NOT_FOUND
        await lifted(served)

    with_plant(segment, test)


def test_several_streams_share_an_injection_and_the_last_lifts_it(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        streams = [await laid(served, path, "s") for path in ("cell/step/in", "CELL://step/in", "/step/in")]
        assert len(present_injections(served)) == 1
        await publish(served, ("cell/step", "7"))
        assert [await value(stream) for stream in streams] == ["7"] * 3
        streams.pop().cancel()
        streams.pop().cancel()
        await publish(served, ("cell/step", "8"))
        assert await value(streams[0]) == "8"
        assert device.written == []
        streams.pop().cancel()
        await lifted(served)

    with_plant(segment, test)


def test_a_shadow_in_use_for_another_target_is_refused(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        originals = await laid(served, "cell/step/in", "s")
        for target in ("cell/step/out", "cell/running/in"):
            status, text = await refusal(inject(served, target, "/s").read())
            assert (status, text) == (Status.ALREADY_EXISTS, "/s is the shadow of cell/step/in; name another path")
        assert len(present_injections(served)) == 1
        originals.cancel()
        await lifted(served)
        (await laid(served, "cell/running/in", "s")).cancel()

    with_plant(segment, test)


def test_elements_and_whole_arrays(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        whole = await laid(served, "cell/inputs/in", "a")
        await publish(served, ("cell/inputs", "[1, 2]"), ("cell/inputs/1", "3"))
        assert [await value(whole) for _ in range(2)] == ["[1,2]", "[1,3]"], "the other elements as last written"
        await publish(served, ("a", "[4, 5]"))
        assert device.memory[10:12] == b"\4\5"
        bit = await laid(served, "cell/bits/9/in", "b")
        await publish(served, ("cell/bits", "[" + "true," * 9 + "true]"), ("b", "0"))
        assert await value(bit) == "true"
        assert device.memory[14:16] == b"\xff\1"
        long = await laid(served, "cell/long/in", "c")
        await publish(served, ("cell/long", str([7] * 600)))
        assert await value(long) == str([7] * 600).replace(" ", "")
        for stream in (whole, bit, long):
            stream.cancel()

    with_plant(segment, test)


def test_injections_on_one_register_form_a_chain(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        inner, outer = await laid(served, "cell/step/in", "i"), await laid(served, "cell/step/in", "o")
        await publish(served, ("cell/step", "1"))
        assert await value(outer) == "1"
        await publish(served, ("o", "2"))
        assert await value(inner) == "2"
        await publish(served, ("i", "3"))
        assert device.memory[12:14] == b"\0\3"
        outer.cancel()
        inner.cancel()
        await lifted(served)
        consumer = served.subscribe("cell/step")
        await seen(consumer, "3")
        inner = await laid(served, "cell/step", "i")
        assert await value(inner) == "3"
        await publish(served, ("i", "4"))
        await seen(consumer, "4")
        outer = await laid(served, "cell/step", "o")
        assert await value(outer) == "4", "the inner injection's value"
        await publish(served, ("o", "5"), ("i", "6"), ("cell/step", "7"))
        await seen(consumer, "5")
        assert await value(outer) == "6"
        assert await value(inner) == "7"
        inner.cancel()
        assert await value(outer) == "7", "the source's value again"
        outer.cancel()
        await seen(consumer, "7")

    with_plant(segment, test)


@pytest.mark.parametrize(
    ("target", "shadow", "status", "reason"),
    [
        ("cell/nothing/in", "s", Status.NOT_FOUND, "no such register"),
        ("", "s", Status.NOT_FOUND, ""),
        ("s", "s", Status.NOT_FOUND, ""),
        ("cell/axis/in", "s", Status.INVALID_ARGUMENT, "for this structure"),
        ("cell/step/in", "", Status.INVALID_ARGUMENT, "printable characters"),
        ("cell/step/in", "/", Status.INVALID_ARGUMENT, "printable characters"),
        ("cell/step/in", "a\nb", Status.INVALID_ARGUMENT, "printable characters"),
        ("cell/step/in", "a" * 1025, Status.INVALID_ARGUMENT, "printable characters"),
        ("cell/step/in", "CELL://step/in", Status.INVALID_ARGUMENT, "another path"),
        ("cell/step/in", "SIMLOG://step", Status.ALREADY_EXISTS, "served by shmio"),
        (
            "cell/secret/in",
            "s",
            Status.FAILED_PRECONDITION,
            "cell/secret/in: rejected: the injection is over /in, but cell/secret is not writable",
        ),
    ],
)
def test_invalid_injections_are_refused_with_the_reason(
    segment: Segment, target: str, shadow: str, status: Status, reason: str
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        found, text = await refusal(inject(served, target, shadow).read())
        assert (found, reason in text) == (status, True), text
        assert present_injections(served) == []

        async def closed() -> bool:
            return served.service.counters[0] == 0

        await served.until(closed)

    with_plant(segment, test)


def test_an_unarmed_source_refuses_injections_on_in_but_not_on_out(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        device = Plant(served.writer, armed=False)
        device.cycle()
        try:
            status, text = await refusal(inject(served, "cell/step/in", "s").read())
            assert status is Status.FAILED_PRECONDITION
            assert "needs `armed = true`" in text
            originals = await laid(served, "cell/step/out", "s")
            originals.cancel()
            await lifted(served)
        finally:
            device.stop()

    serve(segment, test)


def test_unusual_shadow_paths_work(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        for shadow in (
            "a//b",
            "x://y",
            "100%",
            "joints/R3200/Link1/R/position/shadow/out",
            "h\u00e4nde",
            "cell/running",
        ):
            originals = await laid(served, "cell/step/in", shadow)
            await publish(served, (shadow, "1"), ("cell/step/in", "2"))
            assert await value(originals) == "2"
            originals.cancel()
            await lifted(served)
        assert counted(served)[1] == 0

    with_plant(segment, test)


def test_originals_are_sent_again_when_quality_recovers(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        device.cycle()
        originals = await laid(served, "cell/step", "s")
        assert await value(originals) == "0"
        device.memory[13] = 2
        device.quality = Quality.BAD
        device.cycle()
        device.memory[13] = 0
        device.quality = Quality.GOOD
        device.cycle()
        assert await value(originals) == "0"
        originals.cancel()

    with_plant(segment, test, running=False)


def test_the_stream_ends_with_a_reason_when_another_client_lifts_it(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        for target in ("cell/step/in", "cell/step/out"):
            originals = await laid(served, target, "s")
            (one,) = segment.blocks["cell"].injections.read()
            assert one.name.startswith("s of ipv4:127.0.0.1:")
            await asyncio.to_thread(SourceWriter(segment.blocks["cell"], GUEST).lift, one.number)
            while (got := await _end(originals)) is None:
                pass
            assert got == (Status.ABORTED, f"{target}: another program has lifted it")

    with_plant(segment, test)


async def _end(stream: Any) -> tuple[Status, str] | None:
    return (await _next(stream))[1]


async def _next(stream: Any) -> tuple[Any, tuple[Status, str] | None]:
    """Return a message, or the status with which the stream has ended."""
    try:
        return await stream.read(), None
    except grpc.aio.AioRpcError as error:
        return None, (error.code(), str(error.details()))


def test_a_client_that_does_not_read_originals_loses_its_injection(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.streams.outbox.EVENT_BOUND", 20)

    async def test(served: Endpoint, device: Plant) -> None:
        # Fills the client's window value by value, which is slow on a busy host.
        originals = await laid(served, "cell/long/in", "s", timeout=9 * TIMEOUT_S)
        sent: list[str] = []
        while present_injections(served):
            # One by one: a busy host would otherwise queue more than the bound before it could send any.
            sent.append(str([len(sent) % 256] * 600))
            await publish(served, ("cell/long", sent[-1]))
        got, told = [], None
        while told is None:
            message, told = await _next(originals)
            got += [] if message is None else [message.value.replace(" ", "")]
        assert told[0] is Status.RESOURCE_EXHAUSTED
        assert "too slow" in told[1]
        assert len(got) >= 20
        assert got == [text.replace(" ", "") for text in sent[: len(got)]]

    with_plant(segment, test)


Ending = Callable[[Endpoint, Any], Awaitable[None]]


async def _deadline(served: Endpoint, stream: Any) -> None:
    assert await code(everything(stream)) is Status.DEADLINE_EXCEEDED


async def everything(stream: Any) -> None:
    async for _ in stream:
        pass


async def _cancel(served: Endpoint, stream: Any) -> None:
    stream.cancel()


async def _drop(served: Endpoint, stream: Any) -> None:
    await served.channel.close()


@pytest.mark.parametrize("ending", [_deadline, _cancel, _drop])
@pytest.mark.parametrize("target", ["cell/step/in", "cell/step/out"])
def test_however_a_stream_ends_its_injection_is_lifted(segment: Segment, target: str, ending: Ending) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        stream = inject(served, target, "s", timeout=1 if ending is _deadline else TIMEOUT_S)
        await stream.initial_metadata()
        assert len(present_injections(served)) == 1
        await ending(served, stream)
        await lifted(served)

        async def closed() -> bool:
            return served.service.counters[0] == 0

        await served.until(closed)

    with_plant(segment, test)


def test_a_call_cancelled_before_its_answer_leaves_no_injection(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        for turn in range(20):
            stream = inject(served, "cell/step/in", "s")
            for _ in range(turn):
                await asyncio.sleep(0)
            stream.cancel()
        originals = await laid(served, "cell/step/in", "s")
        await publish(served, ("cell/step", "7"))
        assert await value(originals) == "7"
        originals.cancel()
        await lifted(served)

    with_plant(segment, test)


def test_a_value_published_to_the_shadow_before_the_injection_is_laid_counts(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        call: Any = served.stub.Publish(timeout=TIMEOUT_S)
        with device.output.lock:  # delays the source's answer
            stream = inject(served, "cell/step/in", "s")

            async def named() -> bool:
                return served.service._shadows.find("s") is not None

            await served.until(named)
            await call.write(message("s", "8"))
            await call.done_writing()

            async def received() -> bool:
                return any(
                    stream.received for streams in served.service._publisher._streams.values() for stream in streams
                )

            await served.until(received)
            assert present_injections(served) == []
        await call
        assert device.memory[12:14] == b"\0\x08"
        assert counted(served) == (1, 0)
        stream.cancel()
        await lifted(served)

    with_plant(segment, test)


def test_an_injection_that_the_source_does_not_answer_is_never_laid(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shmio.local.writer.WRITE_TIMEOUT_S", 0)

    async def test(served: Endpoint) -> None:
        status, text = await refusal(inject(served, "cell/step/in", "s").read())
        assert status is Status.FAILED_PRECONDITION
        assert "gave no answer in time" in text
        monkeypatch.setattr("shmio.local.writer.WRITE_TIMEOUT_S", TIMEOUT_S)
        device = Plant(served.writer)
        try:
            device.cycle()
            device.run()
            await publish(served, ("cell/step", "1"))
            assert present_injections(served) == []
            (await laid(served, "cell/step/in", "s")).cancel()
            await lifted(served)
        finally:
            device.stop()

    serve(segment, test)


def test_the_number_of_injections_is_limited(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.grpc.services.injection.MAX_INJECTIONS", 2)

    async def test(served: Endpoint, device: Plant) -> None:
        streams = [await laid(served, f"cell/inputs/{place}", f"s{place}") for place in range(2)]
        status, text = await refusal(inject(served, "cell/step", "s").read())
        assert status is Status.RESOURCE_EXHAUSTED
        assert "2 injections cover cell already" in text
        for stream in streams:
            stream.cancel()
        await lifted(served)

    with_plant(segment, test)


def test_a_program_can_add_an_inner_injection(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        originals = await laid(served, "cell/step", "s")
        await value(originals)
        program = SourceWriter(segment.blocks["cell"], GUEST)
        inner = await asyncio.to_thread(program.inject, ["step"], priority=-1, direction=Direction.OUT)
        await asyncio.to_thread(program.shadow, inner, {"step": 11})
        await seen(originals, "11")
        await asyncio.to_thread(program.lift, inner)
        assert await value(originals) == "0"
        originals.cancel()

    with_plant(segment, test)


def test_values_published_to_a_shadow_are_counted_and_refusals_logged(
    segment: Segment, caplog: pytest.LogCaptureFixture
) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        originals = await laid(served, "cell/step", "s")
        await publish(served, ("s", "1"), ("s", "many"), ("s", "2"))
        await counts(served, 2, 1)
        assert "expected a number" in caplog.text
        originals.cancel()

    with_plant(segment, test)


def test_originals_include_the_effect_of_inner_declared_injections(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        consumer = served.subscribe("cell/step")
        program = SourceWriter(segment.blocks["cell"], GUEST)
        declaration = Declaration(name="hundred", target="cell/step", operation="offset", value=100)
        number = await asyncio.to_thread(program.declare, declaration)
        await seen(consumer, "100")
        originals = await laid(served, "cell/step", "s")
        await seen(originals, "100")
        await publish(served, ("cell/step", "4"))
        await seen(originals, "104")
        await asyncio.to_thread(program.lift, number)
        await seen(originals, "4")
        originals.cancel()

    with_plant(segment, test)
