"""``shmio inject`` while it waits: what it does when its injection or its instance ends before it."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import pytest

import shmio
from shmio.model.event import EventKind
from shmio.segment import Segment
from shmio.testing.cell import BIN
from tests.unit.endpoints.conftest import segment as segment  # noqa: PLC0414  the fixture
from tests.unit.endpoints.grpc.services.test_publish import with_plant
from tests.unit.endpoints.harness import Endpoint
from tests.unit.endpoints.plant import Plant

PATIENCE_S = 60


@asynccontextmanager
async def injecting(*words: str) -> AsyncIterator[tuple[asyncio.subprocess.Process, list[int]]]:
    """Run ``shmio inject`` over two registers; yield it with the numbers of its injections."""
    command = [str(BIN / "shmio"), "inject", "--for", "600", *words, "cell/step", "5", "cell/running/in", "true"]
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    assert process.stdout is not None
    try:
        lines = [await asyncio.wait_for(process.stdout.readline(), PATIENCE_S) for _ in range(2)]
        assert all(lines), (await process.communicate())[1]
        yield process, [int(line.partition(b":")[0]) for line in lines]
    finally:
        if process.returncode is None:
            process.kill()
            await process.communicate()


async def end(process: asyncio.subprocess.Process) -> tuple[int | None, str]:
    error = (await asyncio.wait_for(process.communicate(), PATIENCE_S))[1]
    return process.returncode, error.decode()


def options(segment: Segment, served: Endpoint, *, remote: bool) -> tuple[str, str]:
    return ("--host", f"127.0.0.1:{served.port}") if remote else ("--instance", segment.instance)


@pytest.mark.parametrize("remote", [False, True], ids=["local", "host"])
def test_it_ends_when_others_have_lifted_its_injections(segment: Segment, *, remote: bool) -> None:
    async def run(served: Endpoint, _: Plant) -> None:
        async with AsyncExitStack() as stack:
            found = stack.enter_async_context(injecting(*options(segment, served, remote=remote)))
            process, (first, second) = await found
            cell = stack.enter_context(shmio.attach(segment.instance, writable=True))
            events = stack.enter_context(cell.events())
            await asyncio.to_thread(cell.lift, "cell", first)
            assert process.stderr is not None
            said = (await asyncio.wait_for(process.stderr.readline(), PATIENCE_S)).decode()
            assert re.search(rf"^{first}: cell/step/out was lifted by pid {os.getpid()}\n", said)
            await asyncio.to_thread(cell.lift, "cell", second)
            status, error = await end(process)
            assert (status, error.count("\n")) == (1, 1)
            assert re.search(rf"^{second}: cell/running/in was lifted by pid {os.getpid()}\n", error)
            await asyncio.to_thread(cell.note, "the end")
            kinds = []
            for event in events:
                kinds.append(event.kind)
                if event.kind == EventKind.NOTED:
                    break
            assert kinds.count(EventKind.LIFTED) == 2
            assert EventKind.REJECTED not in kinds, "it lifts no injection that is gone"

    with_plant(segment, run)


@pytest.mark.parametrize("remote", [False, True], ids=["local", "host"])
def test_it_ends_when_its_instance_stops(segment: Segment, *, remote: bool) -> None:
    async def run(served: Endpoint, device: Plant) -> None:
        async with injecting(*options(segment, served, remote=remote)) as (process, _):
            device.stop()
            if remote:
                await served.server.stop()
            else:
                segment.unlink()
            status, error = await end(process)
        assert (status, error.count("\n")) == (1, 1)
        assert "has stopped" in error
        assert "not lifted" not in error

    with_plant(segment, run)
