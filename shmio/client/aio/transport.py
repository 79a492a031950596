"""Calls and waiting with asyncio. ``shmio.client.sync.transport`` does the same with threads."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Final

import grpc

from shmio.client import calls
from shmio.client.calls import OPTIONS, Target
from shmio.client.model import Values
from shmio.errors import RemoteError

Outputs = Mapping[str, object] | None
Step = Callable[[float, float, Values], Outputs | Awaitable[Outputs]]
"""Function of ``(time_s, dt_s, inputs)`` that returns the outputs, by path, at the end of a step.

It may be a coroutine function. Times are in s.
"""
CLOSED: Final = grpc.aio.UsageError
"""Error that grpcio raises for a call on a closed channel."""
sleep: Final = asyncio.sleep


async def outputs_of(found: Outputs | Awaitable[Outputs]) -> Outputs:
    """Return the outputs of a step, awaiting them if necessary."""
    return await found if inspect.isawaitable(found) else found


class Channel:
    """The gRPC connection of one client."""

    def __init__(self, target: Target, timeout_s: float) -> None:
        self.target = target
        self.timeout_s = timeout_s
        """Time-out of calls that the endpoint answers at once, in s."""
        self.closed = False
        credentials = target.credentials
        self.grpc = (
            grpc.aio.insecure_channel(target.address, OPTIONS)
            if credentials is None
            else grpc.aio.secure_channel(target.address, credentials, OPTIONS)
        )

    async def close(self) -> None:
        """End all calls, and the connection."""
        self.closed = True
        await self.grpc.close()


class Stream(AsyncIterator[Any]):
    """Iterator over the answers to one request. It ends when the stream or its channel is closed.

    Raises:
        ShmioError: The endpoint ended the stream.
    """

    def __init__(self, channel: Channel, method: Any, *request: Any, timeout_s: float | None = None) -> None:
        self._channel = channel
        self._closed = False
        self._answered = False
        self._call = method(*request, timeout=timeout_s, metadata=channel.target.metadata)

    async def __anext__(self) -> Any:
        found = grpc.aio.EOF
        try:
            with _closing():
                found = await self._call.read()
        except grpc.RpcError as error:
            if not (self._closed or self._channel.closed):
                self._channel.target.fail(error, answered=self._answered)
        if found is grpc.aio.EOF:
            raise StopAsyncIteration
        self._answered = True
        return found

    async def first(self) -> Any:
        """Return the first answer; None if the stream was closed. Raise RemoteError if none comes in time."""
        try:
            async with asyncio.timeout(calls.WRITE_PATIENCE_S):
                return await anext(self, None)
        except TimeoutError:
            raise calls.unanswered(self._channel.target) from None

    async def to_list(self) -> list[Any]:
        """Return all answers. Raise RemoteError if the channel was closed meanwhile."""
        found = [one async for one in self]
        if self._channel.closed:
            raise RemoteError(f"{self._channel.target.address}: the client was closed")
        return found

    def close(self) -> None:
        """End the stream."""
        self._closed = True
        self._call.cancel()


class Duplex(Stream):
    """A stream that can send further requests. It sends its first requests when it is first used."""

    def __init__(self, channel: Channel, method: Any, *first: Any) -> None:
        super().__init__(channel, method)
        self._first = first
        self._lock = asyncio.Lock()  # gRPC accepts one message at a time

    async def __anext__(self) -> Any:
        if self._first:
            await self.write()
        return await super().__anext__()

    async def write(self, *requests: Any) -> None:
        """Send requests.

        If the stream has ended, the requests are lost, and the next read raises the reason.
        """
        async with self._lock:
            requests, self._first = (*self._first, *requests), ()
            with suppress(grpc.RpcError, asyncio.InvalidStateError), _closing():
                for request in requests:
                    await self._call.write(request)

    async def finish(self) -> None:
        """Tell the endpoint that no more requests follow."""
        with suppress(grpc.RpcError, asyncio.InvalidStateError), _closing():
            await self._call.done_writing()


@contextmanager
def _closing() -> Iterator[None]:
    """Suppress CancelledError if the call was cancelled, but not if the task was cancelled."""
    try:
        yield
    except asyncio.CancelledError:
        if (task := asyncio.current_task()) is not None and task.cancelling():
            raise


class Condition(asyncio.Condition):
    """Condition on which several tasks can wait, each with its own time-out."""

    async def wait_until(self, predicate: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until the predicate is true; return False after ``timeout_s`` seconds (None: never)."""
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self.wait_for(predicate)
        return predicate()


class Background:
    """A task that runs a coroutine in the background."""

    def __init__(self, run: Callable[[], Coroutine[Any, Any, None]], name: str) -> None:
        self._task = asyncio.get_running_loop().create_task(run(), name=name)

    async def join(self, timeout_s: float | None = None) -> None:
        """Wait until the coroutine has ended, for at most ``timeout_s`` seconds."""
        await asyncio.wait((self._task,), timeout=timeout_s)
