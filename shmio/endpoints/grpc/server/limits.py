"""Limits what clients can consume: file descriptors, memory, and the time of the event loop."""

from __future__ import annotations

import asyncio
import ctypes
import resource
import time
from collections.abc import AsyncIterator, Callable, Iterable
from typing import Any, Final, TypeVar

# ---- file descriptors ------------------------------------------------------------------------------------

OWN: Final = 256
"""Number of file descriptors to reserve for everything except connections; more than are needed."""
EACH: Final = 1
"""Number of file descriptors that are reserved for each connection."""
FEW: Final = 64
"""Number of connections below which the endpoint reports a shortage."""


def shortage(connections: int, wanted: int) -> str:
    """Return a note for ``shmio-supervisor status`` if too few connections are possible; else an empty text.

    Args:
        connections: Number of possible connections.
        wanted: Number of connections that the configuration allows.
    """
    if connections >= min(FEW, wanted):
        return ""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    return (
        f"the endpoint serves at most {connections} connections at once, not {wanted}: the hard limit of open "
        f"files is {files}; "
        f"raise it to {OWN + EACH * wanted} where the supervisor is started (ulimit -n, or LimitNOFILE= of its "
        "service), and start the instance again"
    )


def room(wanted: int) -> int:
    """Raise the limit on open files as far as necessary and possible.

    Args:
        wanted: Number of connections to make possible.

    Returns:
        Number of connections that the limit allows, at most ``wanted``.
    """
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
"""Maximum number of malloc arenas.

By default each thread has its own arena, and no other thread uses the free memory in it.
"""
FLOOD_CALLS: Final = 1000
"""Number of newly refused calls that count as a flood, during which free memory is returned to the kernel."""
EVERY_S: Final = 5.0
"""Interval in s at which free memory is returned to the kernel."""
AFTER_S: Final = 60.0
"""Time in s for which free memory is still returned after a flood."""


def limit_arenas() -> None:
    """Limit the number of malloc arenas of this process. Call this before you start threads."""
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(M_ARENA_MAX, ARENAS)


class Trimmer:
    """Returns free memory to the kernel during floods of refused calls.

    It continues for a while after a flood, because gRPC frees the memory of a call late.
    """

    def __init__(
        self, clock_s: Callable[[], float] = time.monotonic, trim: Callable[[int], object] | None = None
    ) -> None:
        self._clock_s = clock_s
        self._trim: Any = trim or getattr(ctypes.CDLL(None), "malloc_trim", int)
        self._seen = 0
        self._due_s = self._until_s = 0.0

    def trim(self, refused: int) -> None:
        """Return free memory to the kernel, if that is due.

        Args:
            refused: Number of refused calls so far.

        """
        now_s = self._clock_s()
        if refused - self._seen >= FLOOD_CALLS:
            self._seen, self._until_s = refused, now_s + AFTER_S
        if self._due_s <= now_s < self._until_s:
            self._due_s = now_s + EVERY_S
            self._trim(0)


# ---- the event loop's time -------------------------------------------------------------------------------

HELD_S: Final = 0.005
"""Maximum time in s for which the work for one request may block the event loop."""

T = TypeVar("T")


async def time_sliced(items: Iterable[T]) -> AsyncIterator[T]:
    """Yield the items, and let other tasks run whenever ``HELD_S`` has passed."""
    begun_s = time.perf_counter()
    for item in items:
        yield item
        if time.perf_counter() - begun_s > HELD_S:
            await asyncio.sleep(0)
            begun_s = time.perf_counter()
