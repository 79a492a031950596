"""Returns memory to the host after floods of calls; without effect outside glibc."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import Any, Final

M_ARENA_MAX: Final = -8
ARENAS: Final = 2
"""Number of malloc arenas; by default each thread has its own, whose free memory no other uses."""
FLOOD_CALLS: Final = 1000
"""Number of refused calls after which free memory is returned."""
EVERY_S: Final = 5.0
AFTER_S: Final = 60.0


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
