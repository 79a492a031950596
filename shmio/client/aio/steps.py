"""Many steps by one call."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from typing import Any, Self

from shmio.client import calls
from shmio.client.aio.transport import Duplex
from shmio.client.calls import Stepped
from shmio.errors import CommandError, ShmioError


class Steps(AsyncIterator[Stepped]):
    """Steps of time on one stream, which costs less than a call for each. Close it, or use ``async with``.

    For one task. Iterate over it for those that :meth:`Client.steps` has asked for, in their order: each when all
    streams have what has changed in it, while the next ones go on; and, for a program that does something between
    them, :meth:`step`.
    """

    def __init__(self, stream: Duplex, count: int) -> None:
        """``count``: how many steps the stream has asked for."""
        self._stream = stream
        self._left = count
        self._waiting: Iterator[Any] = iter(())

    async def __anext__(self) -> Stepped:
        """The next one that is done, waited for; ends when all that were asked for are.

        CommandError: it failed, or another program owns time, and none of those behind it is done; ValueRangeError,
        RemoteError.
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
        """Do one more, and wait for it, and for those that were asked for before. Errors as of iterating."""
        await self._stream.write(*calls.steps_requests(1, dt_s))
        self._left += 1
        last = None
        async for done in self:
            last = done
        if last is None:
            raise CommandError("the steps were closed: none is done any more")
        return last

    def close(self) -> None:
        """Ask for no more: a step that was begun is done, those behind it are not."""
        self._left = 0
        self._stream.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
