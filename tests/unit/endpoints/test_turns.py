from __future__ import annotations

import asyncio

from shmio.endpoints.turns import AT_ONCE, Turns


def test_clients_do_not_wait_for_each_other_and_are_forgotten() -> None:
    async def run() -> None:
        turns = Turns()
        busy = [turns.of("a") for _ in range(AT_ONCE)]
        for turn in busy:
            await turn.acquire()
        assert turns.of("a").locked()
        async with turns.of("b"):
            assert not turns.of("b").locked()
        for turn in busy:
            turn.release()
        del busy, turn
        assert len(turns._turns) == 0

    asyncio.run(run())
