"""Long work of a request gives way to the event loop."""

from __future__ import annotations

import asyncio
import time

from shmio.endpoints.grpc.server.time_slices import HELD_S, time_sliced


def test_others_get_their_turn_between_items_that_take_long() -> None:
    seen: list[str] = []

    async def work() -> None:
        async for item in time_sliced(range(3)):
            until_s = time.perf_counter() + HELD_S
            while time.perf_counter() <= until_s:
                pass
            seen.append(str(item))

    async def other() -> None:
        for name in "ab":
            seen.append(name)
            await asyncio.sleep(0)

    async def both() -> None:
        await asyncio.gather(work(), other())

    asyncio.run(both())
    assert seen == ["0", "a", "1", "b", "2"]
