"""Splits long work of one request into time slices, so that the event loop serves others."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterable
from typing import Final, TypeVar

HELD_S: Final = 0.005
"""Longest time that such work may block the event loop at once."""

T = TypeVar("T")


async def time_sliced(items: Iterable[T]) -> AsyncIterator[T]:
    """Yield the items; let other tasks run whenever ``HELD_S`` has passed."""
    begun_s = time.perf_counter()
    for item in items:
        yield item
        if time.perf_counter() - begun_s > HELD_S:
            await asyncio.sleep(0)
            begun_s = time.perf_counter()
