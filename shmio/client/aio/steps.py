"""Many steps by one call."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from typing import Any, Self

from shmio.client import calls
from shmio.client.aio.transport import Duplex
from shmio.client.calls import Stepped
from shmio.errors import CommandError, ShmioError


class Steps(AsyncIterator[Stepped]):
    """Steps of time on one stream, which costs less than one call for each step.

    Close it, or use ``async with``; use it in one task. Iterate over the steps that
    :meth:`Client.steps` requested. Each comes when all streams have its changes, while the next
    steps are already being computed. To do something between steps, call :meth:`step` instead.
    """

    def __init__(self, stream: Duplex, count: int) -> None:
        """Take the stream, and the number of steps that it has requested."""
        self._stream = stream
        self._left = count
        self._waiting: Iterator[Any] = iter(())

    async def __anext__(self) -> Stepped:
        """Wait for the next finished step; the iteration ends after all requested steps.

        Raises:
            CommandError: The step failed, or another program owns time; no later step is done.
            ValueRangeError: The step size is out of range.
            RemoteError: The connection failed.
        """
        if not self._left:
            raise StopAsyncIteration
        while True:
            for found in self._waiting:
                self._left -= 1
                return Stepped.of(found)
            try:
                self._waiting = iter((await anext(self._stream)).steps)
            except ShmioError:
                self.close()
                raise

    async def step(self, dt_s: float | None = None) -> Stepped:
        """Do one more step, and wait for it and all earlier ones; errors as for iteration."""
        await self._stream.write(*calls.steps_requests(1, dt_s))
        self._left += 1
        last = None
        async for done in self:
            last = done
        if last is None:
            raise CommandError("the steps were closed")
        return last

    def close(self) -> None:
        """Cancel the requested steps, except one that has begun."""
        self._left = 0
        self._stream.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
