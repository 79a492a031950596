"""Limits on what clients take from the process: file descriptors, memory, and the event loop's time."""

from __future__ import annotations

import asyncio
import ctypes
import resource
import time
from collections.abc import AsyncIterator, Callable, Iterable
from typing import Any, Final, TypeVar

# ---- file descriptors ------------------------------------------------------------------------------------

OWN: Final = 256
"""Descriptors reserved for everything but connections, because nothing works without; more than enough."""
EACH: Final = 1
"""Descriptors reserved for each connection."""
FEW: Final = 64
"""With fewer connections than this the endpoint reports a shortage."""


def shortage(connections: int, wanted: int) -> str:
    """Return the note for ``status`` if connections are short; empty: there are enough."""
    if connections >= min(FEW, wanted):
        return ""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    return (
        f"it serves at most {connections} connections at once, not {wanted}: the hard limit of open files is {files}; "
        f"raise it to {OWN + EACH * wanted} where the supervisor is started (ulimit -n, or LimitNOFILE= of its "
        "service), and start the instance again"
    )


def room(wanted: int) -> int:
    """Raise the limit of open files as far as needed; return the connections that it allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = OWN + EACH * wanted
    if soft != resource.RLIM_INFINITY and soft < needed:
        soft = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft == resource.RLIM_INFINITY:
        return wanted
    return max(1, min(wanted, (soft - OWN) // EACH))


# ---- memory: without effect outside glibc ----------------------------------------------------------------

M_ARENA_MAX: Final = -8
ARENAS: Final = 2
"""Number of malloc arenas; by default each thread has its own, whose free memory no other uses."""
FLOOD_CALLS: Final = 1000
"""Number of refused calls after which free memory is returned."""
EVERY_S: Final = 5.0
"""Interval at which free memory is returned."""
AFTER_S: Final = 60.0
"""How long after a flood free memory is still returned."""


def limit_arenas() -> None:
    """Limit the malloc arenas that all threads share. Call this before threads start."""
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(M_ARENA_MAX, ARENAS)


class Trimmer:
    """Returns free memory during floods and for a while after: gRPC frees a call's memory later."""

    def __init__(
        self, clock_s: Callable[[], float] = time.monotonic, trim: Callable[[int], object] | None = None
    ) -> None:
        self._clock_s = clock_s
        self._trim: Any = trim or getattr(ctypes.CDLL(None), "malloc_trim", int)
        self._seen = 0
        self._due_s = self._until_s = 0.0

    def look(self, refused: int) -> None:
        """Return free memory if it is time. ``refused``: number of refused calls so far."""
        now_s = self._clock_s()
        if refused - self._seen >= FLOOD_CALLS:
            self._seen, self._until_s = refused, now_s + AFTER_S
        if self._due_s <= now_s < self._until_s:
            self._due_s = now_s + EVERY_S
            self._trim(0)


# ---- the event loop's time -------------------------------------------------------------------------------

HELD_S: Final = 0.005
"""Longest time that one request's work may block the event loop at once."""

T = TypeVar("T")


async def time_sliced(items: Iterable[T]) -> AsyncIterator[T]:
    """Yield the items; let other tasks run whenever ``HELD_S`` has passed."""
    begun_s = time.perf_counter()
    for item in items:
        yield item
        if time.perf_counter() - begun_s > HELD_S:
            await asyncio.sleep(0)
            begun_s = time.perf_counter()
