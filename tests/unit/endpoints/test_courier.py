"""Calls from a thread reach the loop, all and in order."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from shmio.endpoints.grpc.courier import Courier
from tests.unit.endpoints.harness import TIMEOUT_S


def test_all_calls_come_in_their_order_whoever_is_faster() -> None:
    async def test() -> None:
        done = asyncio.Event()
        courier, got = Courier(asyncio.get_running_loop()), list[int]()

        def work() -> None:
            for number in range(20_000):
                courier.post(got.append, number)
            courier.post(done.set)

        thread = threading.Thread(target=work)
        thread.start()
        async with asyncio.timeout(TIMEOUT_S):
            await done.wait()
        thread.join()
        assert got == list(range(20_000))

    asyncio.run(test())


def test_a_call_that_fails_does_not_take_others_with_it() -> None:
    async def test() -> None:
        loop, done, errors = asyncio.get_running_loop(), asyncio.Event(), list[Any]()
        loop.set_exception_handler(lambda _, context: errors.append(context["exception"]))
        courier = Courier(loop)
        courier.post(lambda: 1 // 0)
        courier.post(done.set)
        async with asyncio.timeout(TIMEOUT_S):
            await done.wait()
        assert [type(error) for error in errors] == [ZeroDivisionError]

    asyncio.run(test())


def test_a_busy_loop_is_woken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test() -> None:
        loop, done, calls = asyncio.get_running_loop(), asyncio.Event(), list[object]()
        wake = loop.call_soon_threadsafe

        def count(*arguments: Any) -> Any:
            calls.append(arguments)
            return wake(*arguments)

        monkeypatch.setattr(loop, "call_soon_threadsafe", count)
        courier = Courier(loop)
        for _ in range(100):
            courier.post(int)
        courier.post(done.set)
        async with asyncio.timeout(TIMEOUT_S):
            await done.wait()
        assert len(calls) == 1

    asyncio.run(test())
