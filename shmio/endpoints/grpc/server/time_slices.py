"""Long work of one request in portions: the event loop serves the others in between."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterable
from typing import Final, TypeVar

HELD_S: Final = 0.005
"""How long work may hold the event loop at a time."""

T = TypeVar("T")


async def time_sliced(items: Iterable[T]) -> AsyncIterator[T]:
    """Each of the items; others get their turn whenever those before have taken ``HELD_S``."""
    begun_s = time.perf_counter()
    for item in items:
        yield item
        if time.perf_counter() - begun_s > HELD_S:
            await asyncio.sleep(0)
            begun_s = time.perf_counter()
