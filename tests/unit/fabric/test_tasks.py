"""Ending tasks that lose a cancellation."""

from __future__ import annotations

import asyncio

from shmio.fabric import tasks


def test_a_task_that_loses_its_cancellation_is_ended() -> None:
    async def stubborn(begun: asyncio.Event) -> None:
        try:
            begun.set()
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            pass  # as wait_for() does if the result comes at the same time
        await asyncio.Event().wait()

    async def run() -> None:
        begun = asyncio.Event()
        task = asyncio.create_task(stubborn(begun))
        await begun.wait()
        async with asyncio.timeout(20):
            await tasks.end(task)
        assert task.cancelled()

    asyncio.run(run())


def test_the_exception_of_a_task_stays_in_it() -> None:
    async def failing() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            raise ValueError

    async def run() -> None:
        task = asyncio.create_task(failing())
        await asyncio.sleep(0)
        await tasks.end(task)
        assert isinstance(task.exception(), ValueError)

    asyncio.run(run())
