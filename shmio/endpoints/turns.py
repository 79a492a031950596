"""Limits what one client takes, so that a busy client hardly delays others.

A client has a number of requests at a time. What :meth:`Turn.run` does for it takes at most its share of the event
loop's time (``shares.py``), in slices, one after the other: however many requests and pages a client has, one slice
of it at most comes between the steps of another client.
"""

from __future__ import annotations

import asyncio
import time
import weakref
from collections.abc import Callable, Coroutine, Generator
from types import TracebackType
from typing import Any, Final, TypeVar
from weakref import WeakValueDictionary

from shmio.endpoints.shares import SLICE_S, Share, Shares

AT_ONCE: Final = 2
"""Number of a client's requests that are carried out at a time. Further ones wait for their turn."""

_Result = TypeVar("_Result")


class Turn:
    """What one client has. As a context manager, it is held while a request is carried out."""

    def __init__(self, shares: Shares, at_once: int) -> None:
        self.share = Share(shares)
        """The client's share of the time."""
        self._requests = asyncio.Semaphore(at_once)
        self._slices = asyncio.Lock()
        self._clock = shares.clock
        self._begun_s = 0.0
        self._round_s: float | None = None
        weakref.finalize(self, self.share.close)

    async def __aenter__(self) -> None:
        await self._requests.acquire()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self._requests.release()

    async def run(self, work: Coroutine[Any, Any, _Result]) -> _Result:
        """Run a coroutine. Each of its steps waits for the client's other work, and while its share is used up."""
        result: _Result = await _InSlices(self, work)
        return result

    async def pause(self) -> None:
        """End the present slice if it is over. Work that takes long calls this between its parts."""
        if self.share.over:
            await asyncio.sleep(0)

    async def in_thread(self, work: Callable[..., _Result], *arguments: object) -> _Result:
        """Call a function in another thread. The processor time that it takes counts towards the client's share."""

        def timed() -> tuple[_Result, float]:
            begun_s = time.thread_time()
            result = work(*arguments)
            return result, time.thread_time() - begun_s

        result, used_s = await asyncio.to_thread(timed)
        self.share.count_time(used_s)
        return result

    async def take_slice(self) -> None:
        """Wait for the client's next slice. The caller must then call :meth:`end_slice`."""
        await self._slices.acquire()
        try:
            if wait_s := self.share.wait_s:
                await asyncio.sleep(wait_s)
        except BaseException:
            self._slices.release()
            raise
        self._begun_s = self._clock()

    def end_slice(self) -> None:
        """End the slice. If the client has had ``SLICE_S`` in this round of the event loop, others proceed first."""
        if self._round_s is None:
            self._round_s = 0.0
            asyncio.get_running_loop().call_soon(self._end_round)
        self._round_s += self._clock() - self._begun_s
        if self._round_s < SLICE_S:
            self._slices.release()

    def _end_round(self) -> None:
        if self._round_s is not None and self._round_s >= SLICE_S:
            self._slices.release()
        self._round_s = None


class _InSlices:
    """Runs a coroutine inside another, each step in a slice of the client's time."""

    def __init__(self, turn: Turn, work: Coroutine[Any, Any, Any]) -> None:
        self._turn, self._work = turn, work

    def __await__(self) -> Generator[Any, Any, Any]:
        proceed: Callable[[], Any] = lambda: self._work.send(None)  # noqa: E731
        in_slice = True
        while True:
            if in_slice:
                try:
                    yield from self._turn.take_slice().__await__()
                except BaseException as error:  # noqa: BLE001  the work is cancelled
                    in_slice = False
                    proceed = lambda error=error: self._work.throw(error)  # type: ignore[misc]  # noqa: E731
            try:
                with self._turn.share:
                    awaited = proceed()
            except StopIteration as end:
                return end.value
            finally:
                if in_slice:
                    self._turn.end_slice()
            in_slice = True
            try:
                given = yield awaited
            except BaseException as error:  # noqa: BLE001  the coroutine handles it, without waiting for a slice
                in_slice = False
                proceed = lambda error=error: self._work.throw(error)  # type: ignore[misc]  # noqa: E731
            else:
                proceed = lambda given=given: self._work.send(given)  # type: ignore[misc]  # noqa: E731


class Turns:
    """The turns of all clients. Use it in the event loop's thread only."""

    def __init__(self, at_once: int = AT_ONCE) -> None:
        self._at_once = at_once
        self._shares = Shares()
        self._turns: WeakValueDictionary[str, Turn] = WeakValueDictionary()

    def of(self, client: str) -> Turn:
        """Return what a client has. It lasts as long as it is used."""
        turn = self._turns.get(client)
        if turn is None:
            turn = self._turns[client] = Turn(self._shares, self._at_once)
        return turn
