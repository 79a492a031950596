from __future__ import annotations

import asyncio

import pytest

from shmio.endpoints import turns as turns_module
from shmio.endpoints.shares import ALL_SHARE, BURST_S, CLIENT_SHARE, SLICE_S, Shares
from shmio.endpoints.turns import AT_ONCE, Turn, Turns


class Clock:
    """A clock that only work and waits move on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        self._pass = asyncio.sleep
        monkeypatch.setattr(turns_module, "Shares", lambda: Shares(lambda: self.now_s))
        monkeypatch.setattr(asyncio, "sleep", self._sleep)

    async def _sleep(self, time_s: float) -> None:
        self.now_s += time_s
        await self._pass(0)

    async def work(self, steps: int, step_s: float = 0.01, done: list[str] | None = None, name: str = "") -> float:
        """Work in steps; return when they are done."""
        for _ in range(steps):
            self.now_s += step_s
            if done is not None:
                done.append(name)
            await self._pass(0)
        return self.now_s


def test_clients_do_not_wait_for_each_other_and_are_forgotten() -> None:
    async def run() -> None:
        turns = Turns()
        busy = turns.of("a")
        for _ in range(AT_ONCE):
            await busy.__aenter__()
        waiting = asyncio.ensure_future(busy.__aenter__())
        async with turns.of("b"):
            await asyncio.sleep(0)
            assert not waiting.done()
        await busy.__aexit__(None, None, None)
        await waiting
        del busy
        assert len(turns._turns) == 0
        assert turns._shares._open == 0

    asyncio.run(run())


def test_another_client_waits_for_one_slice_however_many_tasks_a_client_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the steps of another client, 50 tasks of a client have no more steps than a single one has."""
    clock = Clock(monkeypatch)

    async def run(tasks: int) -> int:
        turns = Turns()
        busy, other = turns.of("busy"), turns.of("other")
        done: list[str] = []

        async def work(name: str, steps: int) -> None:
            await clock.work(steps, SLICE_S if name == "busy" else 0.0, done, name)

        load = [asyncio.create_task(busy.run(work("busy", 100))) for _ in range(tasks)]
        await asyncio.sleep(0)
        await other.run(work("other", 20))
        for task in load:
            task.cancel()
        await asyncio.gather(*load, return_exceptions=True)
        first = done.index("other")
        last = len(done) - 1 - done[::-1].index("other")
        return done[first:last].count("busy")

    assert asyncio.run(run(50)) <= asyncio.run(run(1)) > 0


def test_a_client_waits_when_its_share_is_used_up_unless_it_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)

    async def run(others: int) -> float:
        turns = Turns()
        present = [turns.of(f"other {number}") for number in range(others)]
        begun_s = clock.now_s
        steps = 1000
        ended_s = await turns.of("busy").run(clock.work(steps))
        assert len(present) == others
        return (ended_s - begun_s) / (steps * 0.01 - BURST_S)

    assert asyncio.run(run(0)) == pytest.approx(1 / 0.9, rel=0.02)
    assert asyncio.run(run(1)) == pytest.approx(1 / min(CLIENT_SHARE, ALL_SHARE), rel=0.1)


def test_work_gets_its_result_its_error_and_its_cancellation() -> None:
    async def run() -> None:
        turn = Turns().of("a")

        async def fails() -> None:
            await asyncio.sleep(0)
            raise LookupError("x")

        async def waits(seen: list[str]) -> None:
            try:
                await asyncio.Event().wait()
            finally:
                seen.append("ended")

        assert await turn.run(asyncio.sleep(0, 5)) == 5
        assert await turn.in_thread(lambda number: number + 1, 2) == 3
        with pytest.raises(LookupError):
            await turn.run(fails())
        for slice_is_taken in (False, True):
            seen: list[str] = []
            task = asyncio.create_task(turn.run(waits(seen)))
            for _ in range(3):
                await asyncio.sleep(0)
            if slice_is_taken:
                await turn.take_slice()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            assert (task.cancelled(), seen) == (True, ["ended"])
        turn.end_slice()
        assert await turn.run(asyncio.sleep(0, 6)) == 6

    asyncio.run(run())


def test_time_in_another_thread_counts() -> None:
    async def run() -> float:
        turn = Turn(Shares(lambda: 0.0), 1)
        turn.share._shares.open()

        def work() -> None:
            total = 0
            for number in range(100_000):
                total += number

        before_s = turn.share._credit_s
        await turn.in_thread(work)
        return before_s - turn.share._credit_s

    assert asyncio.run(run()) > 0
