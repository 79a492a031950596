"""Replays are controlled by shmio.v1, and its clients see them step by step."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from shmio.client import connect, connect_aio
from shmio.connectors.replay.loop import Search
from shmio.errors import CommandError, PathError, ShmioError, ValueRangeError
from tests.unit.connectors.replay.harness import PATIENCE_S, PERIOD_NS, Playing, built, record
from tests.unit.endpoints.harness import Endpoint, serve

Test = Callable[[Endpoint, Playing], Awaitable[None]]


def replay(folder: Path, instance: str, test: Test, *, stepped: bool = False) -> None:
    """Serve a replay that starts paused, or in virtual time."""
    file = record(folder, instance)
    with built(instance, stepped=stepped) as segment, Playing(segment, file, paused=not stepped) as playing:
        playing.next()
        serve(segment, lambda served: test(served, playing))


def test_a_client_controls_the_replay(tmp_path: Path, instance: str) -> None:
    async def test(served: Endpoint, playing: Playing) -> None:
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            [status] = await cell.replay()
            assert (status.source, status.paused, status.position_s, status.length_s) == ("cell", True, 0, 0.4)
            assert (status.until_s, status.loop, status.over, status.speed) == (None, False, False, 1)
            [status] = await cell.replay(seek=0.1, speed=2, loop=True)
            assert (status.position_s, status.speed, status.loop) == (0.1, 2, True)
            [status] = await cell.replay(change="cell/other", jump=True)
            assert status.position_s == 0.2
            assert (await cell.read("cell/other"))["cell/other"] == 1
            [status] = await cell.replay(paused=False, until="0.3", sources=["cell"])
            assert status.until_s in (0.3, None)
            await asyncio.to_thread(playing.until, lambda: playing.loop.counters.polls >= 8)

    replay(tmp_path, instance, test)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"speed": 0.0}, ValueRangeError),
        ({"seek": 1}, ValueRangeError),
        ({"seek": "x" * 5000}, ValueRangeError),
        ({"change": "cell/none"}, PathError),
        ({"paused": True, "sources": ["none"]}, PathError),
        ({"sources": ["none"]}, PathError),
        ({"event": "none"}, CommandError),
    ],
)
def test_invalid_replay_requests_are_refused(
    tmp_path: Path, instance: str, changes: object, error: type[ShmioError]
) -> None:
    async def test(served: Endpoint, _: Playing) -> None:
        def call() -> None:
            with connect(f"127.0.0.1:{served.port}") as cell, pytest.raises(error):
                cell.replay(**changes)  # type: ignore[arg-type]

        await asyncio.to_thread(call)

    replay(tmp_path, instance, test)


def test_a_search_does_not_block_others_and_ends_with_its_call(
    tmp_path: Path, instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = threading.Event()
    monkeypatch.setattr(Search, "advance", lambda _: begun.set())  # a search that never ends

    async def test(served: Endpoint, _: Playing) -> None:
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            search = asyncio.create_task(cell.replay(event="noted"))
            assert await asyncio.to_thread(begun.wait, PATIENCE_S)
            [status] = await cell.replay()
            assert status.paused
            search.cancel()
            [status] = await cell.replay(seek=0.1)
            assert status.position_s == 0.1

    replay(tmp_path, instance, test)


def test_replay_is_refused_if_no_source_plays_a_recording(instance: str) -> None:
    async def test(served: Endpoint) -> None:
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            with pytest.raises(CommandError, match="plays no recording"):
                await cell.replay()

    with built(instance) as segment:
        serve(segment, test)


def test_a_step_delivers_the_frames_that_it_played(tmp_path: Path, instance: str) -> None:
    async def test(served: Endpoint, _: Playing) -> None:
        async with connect_aio(f"127.0.0.1:{served.port}") as cell:
            seen = []
            for _step in range(5):
                await cell.step(2 * PERIOD_NS / 1e9)
                seen.append((await cell.read("cell/count"))["cell/count"])
            assert seen == [2, 4, 6, 8, 10]

    replay(tmp_path, instance, test, stepped=True)
