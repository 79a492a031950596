"""Many steps by one call, for asyncio."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from typing import Any, Self

import grpc

from shmio.client import calls
from shmio.client.aio.calls import receive
from shmio.client.calls import Stepped, Target


class Steps(AsyncIterator[Stepped]):
    """As :class:`shmio.client.Steps`."""

    def __init__(self, call: Any, target: Target, count: int, dt_s: float | None) -> None:
        """ValueRangeError."""
        self._call = call
        self._target = target
        self._left = count
        self._waiting: Iterator[Any] = iter(())
        self._requests = calls.steps_requests(count, dt_s)

    async def __anext__(self) -> Stepped:
        """As that of :class:`shmio.client.Steps`."""
        if not self._left:
            raise StopAsyncIteration
        await self._ask()
        while True:
            for found in self._waiting:
                self._left -= 1
                return Stepped.of(found)
            self._waiting = iter((await receive(self._call, self._target.fail)).steps)

    async def step(self, dt_s: float | None = None) -> Stepped:
        """As that of :class:`shmio.client.Steps`."""
        self._requests += calls.steps_requests(1, dt_s)
        self._left += 1
        async for found in self:
            last = found
        return last

    async def _ask(self) -> None:
        requests, self._requests = self._requests, []
        try:
            for request in requests:
                await self._call.write(request)
        except grpc.RpcError as error:
            self._target.fail(error)

    def close(self) -> None:
        """As that of :class:`shmio.client.Steps`."""
        self._left = 0
        self._call.cancel()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
