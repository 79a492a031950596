"""A model as a program with asyncio serves it."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any, NoReturn, Self

import grpc

from shmio.client import model
from shmio.client.aio.calls import receive
from shmio.client.calls import Target
from shmio.client.model import Member, Part, Work
from shmio.errors import ConflictError, RemoteError

_Outputs = Mapping[str, object] | None
Step = Callable[[float, float, model.Values], _Outputs | Awaitable[_Outputs]]
"""As that of :mod:`shmio.client.sync.model`; it may be a coroutine function."""


class Simulation(Member, AsyncIterator[Work]):
    """As :class:`shmio.client.sync.model.Simulation`."""

    def __init__(self, call: Any, part: Part, target: Target) -> None:
        super().__init__(part)
        self._call = call
        self._target = target
        self._closed = False

    @classmethod
    async def join(cls, method: Any, target: Target, source: str, name: str) -> Self:
        """Join a source."""
        call = method(metadata=target.metadata)
        try:
            with suppress(asyncio.InvalidStateError):  # it has ended already, and says why
                await call.write(model.join(source, name))
            found = await call.read()
            return cls(call, Part(None if found is grpc.aio.EOF else found), target)
        except grpc.RpcError as error:
            target.fail(error)
        except BaseException:
            call.cancel()
            raise

    async def __anext__(self) -> Work:
        """As that of :class:`shmio.client.sync.model.Simulation`."""
        self._work = self._part.take(await receive(self._call, self._fail))
        return self._work

    async def done(self, outputs: Mapping[str, object]) -> None:
        """Answer the present step with outputs by their paths. PathError, ValueRangeError: nothing has been sent."""
        await self._answer(self._part.done(self._present(), outputs))

    async def fail(self, reason: str) -> None:
        """Answer the present step: it has failed, and why."""
        await self._answer(self._part.failed(self._present(), reason))

    async def compute(self, work: Work, step: Step, rejoining: model.Rejoining) -> None:
        """Answer a step with what a program's code says to it, and with what that raises."""
        rejoining.heed(self._part, work)
        try:
            found = step(work.time_s, work.dt_s, work.inputs)
            outputs = await found if inspect.isawaitable(found) else found
            answer = rejoining.answer(self._part, work, outputs)
        except Exception as error:  # noqa: BLE001  whatever it is, the step has failed with it
            answer = rejoining.failed(self._part, work, error)
        await self._answer(answer)

    def _fail(self, error: Any) -> NoReturn:
        if self._closed:
            raise StopAsyncIteration
        self._target.fail(error)

    async def _answer(self, data: bytes) -> None:
        self._work = None
        with suppress(grpc.RpcError, asyncio.InvalidStateError):  # it is over, which the next step tells
            await self._call.write(data)

    def close(self) -> None:
        """Leave: steps fail until another joins."""
        self._closed = True
        self._call.cancel()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


async def serve(
    join: Callable[[], Awaitable[Simulation]],
    step: Step,
    start: Callable[[Simulation], object] | None,
    patience_s: float,
) -> None:
    """Compute a source until its client is closed; what :meth:`Client.simulate` says."""
    rejoining = model.Rejoining(patience_s)
    while True:
        try:
            async with await join() as simulation:
                if start is not None:
                    start(simulation)
                rejoining.joined()
                async for work in simulation:
                    await simulation.compute(work, step, rejoining)
                return
        except (RemoteError, ConflictError) as error:
            if not rejoining.patient(error):
                raise
            await asyncio.sleep(model.RETRY_S)
