"""What may block for long, done beside the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from typing import Any, TypeVar

_Result = TypeVar("_Result")


class Errands:
    """Calls functions one after another in a thread of its own, which a call that hangs keeps but the process not."""

    def __init__(self, name: str, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._open = 0
        self._calls: SimpleQueue[tuple[Callable[[], Any], asyncio.Future[Any]] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a call is under way."""
        return self._open > 0

    async def call(self, function: Callable[[], _Result]) -> _Result:
        """What the function returns, or raises. It is called even if nobody waits for it any more."""
        future: asyncio.Future[_Result] = self._loop.create_future()
        self._open += 1
        self._calls.put((function, future))
        return await future

    def stop(self) -> None:
        """Have the thread end after what it has to do."""
        self._calls.put(None)

    def join(self) -> None:
        """Wait until it has."""
        self._thread.join()

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            function, future = call
            try:
                result = function()
            except Exception as error:  # noqa: BLE001  it is the caller's
                self._tell(future, None, error)
            else:
                self._tell(future, result, None)

    def _tell(self, future: asyncio.Future[Any], result: object, error: Exception | None) -> None:
        with suppress(RuntimeError):  # the loop has ended, and who waited with it
            self._loop.call_soon_threadsafe(self._end, future, result, error)

    def _end(self, future: asyncio.Future[Any], result: object, error: Exception | None) -> None:
        self._open -= 1
        if future.done():
            return
        if error is None:
            future.set_result(result)
        else:
            future.set_exception(error)
