"""Limits of file descriptors, memory and event-loop time that clients can use."""

from __future__ import annotations

import asyncio
import resource
import time

import pytest

from shmio.endpoints.grpc.server.limits import (
    AFTER_S,
    EACH,
    EVERY_S,
    FEW,
    FLOOD_CALLS,
    HELD_S,
    OWN,
    Trimmer,
    room,
    shortage,
    time_sliced,
)

INFINITE = resource.RLIM_INFINITY


@pytest.mark.parametrize(
    ("soft", "hard", "connections", "after"),
    [
        (20_000, 20_000, 2048, 20_000),
        (1024, 20_000, 2048, OWN + EACH * 2048),
        (1024, INFINITE, 2048, OWN + EACH * 2048),
        (1024, 1024, (1024 - OWN) // EACH, 1024),
        (1024, 2048, (2048 - OWN) // EACH, 2048),
        (INFINITE, INFINITE, 2048, INFINITE),
        (64, 64, 1, 64),
    ],
)
def test_the_limit_of_open_files_is_raised_as_far_as_allowed(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, connections: int, after: int
) -> None:
    limits = [soft, hard]
    monkeypatch.setattr(resource, "getrlimit", lambda _: tuple(limits))
    monkeypatch.setattr(resource, "setrlimit", lambda _, new: limits.__setitem__(slice(None), new))
    assert room(2048) == connections
    assert limits == [after, hard]


def test_a_shortage_of_connections_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (64, 64))
    told = shortage(1, 2048)
    assert told.startswith(
        "the endpoint serves at most 1 connections at once, not 2048: the hard limit of open files is 64; raise"
    )
    assert shortage(FEW, 2048) == ""
    assert shortage(2, 2) == ""


def test_free_memory_is_returned_repeatedly_after_a_flood() -> None:
    now_s, trims = 100.0, []
    trimmer = Trimmer(lambda: now_s, lambda _: trims.append(now_s))
    trimmer.trim(FLOOD_CALLS - 1)
    assert trims == [], "a few calls do not count as a flood"
    trimmer.trim(FLOOD_CALLS)
    for _ in range(200):
        now_s += EVERY_S / 2
        trimmer.trim(FLOOD_CALLS)
    assert trims == [100.0 + EVERY_S * number for number in range(round(AFTER_S / EVERY_S))]


def test_other_tasks_run_between_slow_items() -> None:
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
