"""An injection as a program with asyncio holds it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from typing import Any, Self

import grpc

from shmio.client import calls, injection
from shmio.client.calls import Outcome, Target
from shmio.client.update import Update
from shmio.errors import CommandError, RemoteError, ShmioError


class Shadow(AsyncIterator[Update]):
    """As :class:`shmio.client.Shadow`."""

    def __init__(self, call: Any, held: injection.Held, target: Target) -> None:
        self._call = call
        self._held = held
        self._target = target
        self.number = held.number
        """By which anybody may lift it."""
        self.table = held.table
        self._answers: dict[int, asyncio.Future[Any]] = {}
        self._updates: list[Update] = []
        self._error: ShmioError | None = None
        self._over = False
        self._news = asyncio.Event()
        self._turn = asyncio.Lock()
        self._reading = asyncio.get_running_loop().create_task(self._read())

    async def set(
        self,
        values: Mapping[str, object] | None = None,
        arrays: injection.Arrays | None = None,
        raw: injection.Raw = (),
    ) -> list[Outcome]:
        """As :meth:`shmio.client.Shadow.set`."""
        values, raw = values or {}, list(raw)
        self._check()
        sequence, data = self._held.request(values, arrays, raw, answered=True)
        answer = self._answers[sequence] = asyncio.get_running_loop().create_future()
        await self._write(data)
        try:
            outcome = await asyncio.wait_for(answer, calls.WRITE_PATIENCE_S)
        except TimeoutError:
            raise RemoteError(f"{self._target.address}: it did not answer in time") from None
        finally:
            self._answers.pop(sequence, None)
        return injection.ends(values, outcome, more=bool(arrays or raw))

    async def send(
        self,
        values: Mapping[str, object] | None = None,
        arrays: injection.Arrays | None = None,
        raw: injection.Raw = (),
    ) -> None:
        """As :meth:`shmio.client.Shadow.send`."""
        self._check()
        await self._write(self._held.request(values or {}, arrays, raw, answered=False)[1])

    async def __anext__(self) -> Update:
        """The next original, waited for; ends when it is over. Asked for with ``originals``."""
        while not self._updates:
            self._news.clear()
            if self._held.waits:
                self._updates.extend(self._held.originals())
            elif self._error is not None:
                raise self._error
            elif self._over:
                raise StopAsyncIteration
            else:
                await self._news.wait()
        return self._updates.pop(0)

    def _check(self) -> None:
        if self._error is not None:
            raise self._error
        if self._over:
            raise CommandError(f"the injection {self.number} is over")

    async def _write(self, data: bytes) -> None:
        async with self._turn:
            try:
                await self._call.write(data)
            except (grpc.RpcError, asyncio.InvalidStateError):
                await asyncio.wait((self._reading,))
                self._check()

    async def _read(self) -> None:
        error: ShmioError | None = None
        try:
            while (found := await self._call.read()) is not grpc.aio.EOF:
                self._held.keep(found)
                for answer in found.answers:
                    if (waiting := self._answers.get(answer.sequence)) and not waiting.done():
                        waiting.set_result(answer.outcome)
                self._news.set()
        except grpc.RpcError as caught:
            error = None if self._call.cancelled() else self._target.error(caught)
        except ShmioError as caught:
            error = caught
        finally:
            self._error, self._over = error, True
            self._news.set()
            for waiting in self._answers.values():
                if not waiting.done():
                    waiting.set_exception(error or CommandError(f"the injection {self.number} is over"))

    async def close(self) -> None:
        """Lift it, unless it is to be kept."""
        with suppress(grpc.RpcError, asyncio.InvalidStateError):
            await self._call.done_writing()
        await asyncio.wait((self._reading,), timeout=10)
        self._call.cancel()
        await asyncio.wait((self._reading,))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
