"""Ends tasks that wait for a NATS server."""

from __future__ import annotations

import asyncio
from typing import Any, Final

REPEAT_S: Final = 0.25


async def end(task: asyncio.Task[Any]) -> None:
    """Cancel a task until it has ended. Its result or exception stays in the task.

    One cancellation may have no effect: before Python 3.12, ``asyncio.wait_for`` loses it if the awaited
    result comes at the same time, and nats-py catches it while it closes a connection.
    """
    while not task.done():
        task.cancel()
        await asyncio.wait((task,), timeout=REPEAT_S)
