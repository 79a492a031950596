"""The changed NATS client."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from shmio.fabric.client import FabricClient


class _Stuck(FabricClient):
    """A client whose ``close`` loses a cancellation, as the library's does, and then waits for a dead server."""

    ended = False

    async def close(self) -> None:
        with suppress(asyncio.CancelledError):
            await asyncio.Event().wait()
        try:
            await asyncio.Event().wait()
        finally:
            self.ended = True


def test_leaving_a_server_that_does_not_answer_takes_a_limited_time() -> None:
    async def run() -> None:
        client = _Stuck()
        async with asyncio.timeout(20):
            await client.leave(0.01)
        assert client.ended

    asyncio.run(run())
