"""Models that disconnect, stop half-way or never read. Afterwards their source is free for another model."""

from __future__ import annotations

import asyncio

import grpc
import pytest

from shmio.segment import Quality
from shmio.wire import shmio_v1_pb2 as wire
from tests.unit.connectors.models.test_stepped import Running
from tests.unit.endpoints import http2
from tests.unit.endpoints.grpc.shmio_v1.remote import serve_remote, shown
from tests.unit.endpoints.grpc.shmio_v1.test_simulate import Raw, assigned, read, stepping
from tests.unit.endpoints.grpc.test_rude import NARROW, until_calls
from tests.unit.endpoints.harness import Endpoint, refusal
from tests.unit.endpoints.rude import OURS, Call, begin, connect, status

Status = grpc.StatusCode
JOIN = Call(
    OURS + "Simulate", wire.SimulateRequest(join=wire.Join(source="drive", name="rude")).SerializeToString(), many=True
)


async def free(served: Endpoint, drive: Running, value: int) -> None:
    """Wait until no call is open, then compute the source with another model."""

    async def none() -> bool:
        await asyncio.sleep(0)
        return not len(served.server.calls)

    await served.until(none)
    model = Raw(served)
    await model.join(name="polite")
    await shown(drive, Quality.GOOD)
    step = stepping(served)
    await model.done((await model.work()).step, assignments=assigned(**{"axis/count": value}))
    await step
    assert (await read(served))["axis/count"] == value
    await model.call.done_writing()
    assert await model.call.read() is grpc.aio.EOF
    await shown(drive, Quality.BAD)


@pytest.mark.parametrize("reset", [False, True], ids=["end", "reset"])
@pytest.mark.parametrize("stage", ["headers", "part of the message", "message", "within a step", "half-close"])
def test_a_models_connection_breaks(instance: str, stage: str, reset: bool) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        whole = http2.message(JOIN.request)
        sent = {"headers": 0, "part of the message": len(whole) - 1}.get(stage, len(whole))
        connection = await http2.Connection.open(served.port)
        await connection.send(http2.headers(JOIN.method))
        end = http2.END_STREAM if stage == "half-close" else 0
        if sent:
            await connection.send(http2.frame(http2.DATA, end, 1, whole[:sent]))
        if end:
            await connection.until_end(1)
        elif sent == len(whole):
            await shown(drive, Quality.GOOD)
        else:
            await until_calls(served, 1)
        if stage == "within a step":
            step = stepping(served)
            link = served.segment.blocks["drive"].model_channel
            assert link is not None

            async def asked() -> bool:
                await asyncio.sleep(0)
                return link.newest() is not None

            await served.until(asked)
            await connection.drop(reset=reset)
            code, text = await refusal(step)
            assert (code, "model 'rude' disconnected before it answered" in text) == (Status.FAILED_PRECONDITION, True)
        else:
            await connection.drop(reset=reset)
        await free(served, drive, 1)

    serve_remote(instance, test)


def test_a_models_call_is_cancelled_half_closed_or_reaches_its_deadline(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        async with connect(served) as channel:
            begin(channel, JOIN).cancel()
            silent = begin(channel, JOIN)
            await until_calls(served, 1)
            silent.cancel()
            await free(served, drive, 1)
            cancelled = begin(channel, JOIN)
            await cancelled.write(JOIN.request)
            await shown(drive, Quality.GOOD)
            cancelled.cancel()
            await free(served, drive, 2)
            empty = begin(channel, JOIN)
            await empty.done_writing()
            assert await status(empty) is Status.INVALID_ARGUMENT
            closed = begin(channel, JOIN)
            await closed.write(JOIN.request)
            await closed.done_writing()
            assert await status(closed) is Status.OK
            await free(served, drive, 3)
            assert await status(begin(channel, JOIN, 0.02)) is Status.DEADLINE_EXCEEDED
            late = begin(channel, JOIN, 1)
            await late.write(JOIN.request)
            await shown(drive, Quality.GOOD)
            assert await status(late) is Status.DEADLINE_EXCEEDED
            await free(served, drive, 4)

    serve_remote(instance, test)


def test_a_model_that_never_reads_fails_its_steps_and_delays_no_other(instance: str) -> None:
    async def test(served: Endpoint, drive: Running) -> None:
        connection = await http2.Connection.open(served.port)
        await connection.send(NARROW)
        await connection.send(http2.headers(JOIN.method))
        await connection.send(http2.frame(http2.DATA, 0, 1, http2.message(JOIN.request)))
        await shown(drive, Quality.GOOD)
        code, text = await refusal(stepping(served))
        assert (code, "model 'rude' did not answer within 2000 ms" in text) == (Status.FAILED_PRECONDITION, True)
        code, text = await refusal(Raw(served).join())
        assert (code, "model 'rude'" in text) == (Status.ALREADY_EXISTS, True)
        assert (await read(served))["axis/position"] == 0.25
        await connection.drop(reset=True)
        await free(served, drive, 1)

    serve_remote(instance, test, timeout_ms=2000)
