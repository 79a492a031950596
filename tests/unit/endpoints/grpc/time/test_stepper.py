"""How a step waits in the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Generator
from typing import Any

from shmio.endpoints.grpc.time.stepper import StepDriver
from shmio.local.time_control import Step, StepWait

MANY = 1_000_000
DONE = Step(1, 50, 50)


class Block:
    """A block whose doorbell always rings while the event loop's thread waits for it."""

    model_channel: object = None

    @property
    def ring(self) -> Block:
        return self

    def wait(self, seen: int, timeout_ns: int) -> int:
        assert timeout_ns > 0
        return seen + 1

    def doorbell(self) -> int:
        return 0


class Bells:
    """Doorbells that ring at the next turn of the event loop."""

    def join(self, block: Any, ring: Callable[[], object]) -> None:
        asyncio.get_running_loop().call_soon(ring)

    def leave(self, block: Any, ring: Callable[[], object]) -> None: ...


def test_a_source_that_rings_often_before_it_answers_does_not_block_the_loop() -> None:
    turns: list[int] = []
    waits: list[int] = []

    class Coordinator:
        def stepping(self, dt_ns: int | None) -> Generator[StepWait, None, Step]:
            block: Any = Block()
            while len(waits) < MANY and len(turns) < 3:
                waits.append(0)
                yield StepWait(block, 0, 1_000_000_000)
            return DONE

    async def others() -> None:
        while len(turns) < 3:
            turns.append(0)
            await asyncio.sleep(0)

    async def test() -> None:
        coordinator, clock, wake_ups = Coordinator(), None, Bells()
        driver = StepDriver(coordinator, clock, wake_ups)  # type: ignore[arg-type]  # only what the driver uses
        beside = asyncio.create_task(others())
        assert await driver.step(None) == DONE
        await beside

    asyncio.run(test())
    assert len(waits) < MANY


def test_a_source_with_a_remote_model_does_not_block_the_loop() -> None:
    class Modelled(Block):
        model_channel = object()

        def wait(self, seen: int, timeout_ns: int) -> int:
            raise AssertionError("the loop must be free for the model's answer")

    class Coordinator:
        def stepping(self, dt_ns: int | None) -> Generator[StepWait, None, Step]:
            block: Any = Modelled()
            yield StepWait(block, 0, 1_000_000_000)
            return DONE

    async def test() -> None:
        driver = StepDriver(Coordinator(), None, Bells())  # type: ignore[arg-type]  # only what the driver uses
        assert await driver.step(None) == DONE

    asyncio.run(test())
