"""Runs an event loop in a thread, for the emulators whose servers need asyncio."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from shmio.logs import log_loop_errors

_Result = TypeVar("_Result")


class LoopThread:
    """An event loop in its own thread. Start it once."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread."""
        self._loop = asyncio.new_event_loop()  # not earlier: a check makes emulators that it does not start
        log_loop_errors(self._loop)
        self._thread = threading.Thread(target=self._loop.run_forever, name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Cancel all tasks in the loop; return when the thread has ended."""
        if self._thread is None:
            return
        if self._thread.is_alive():
            self.run(_cancel_others)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._loop.close()

    def run(self, function: Callable[..., Coroutine[Any, Any, _Result]], *arguments: Any) -> _Result:
        """Run a coroutine function in the loop; return its result. Call it from other threads only."""
        return asyncio.run_coroutine_threadsafe(function(*arguments), self._loop).result()


async def _cancel_others() -> None:
    others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
