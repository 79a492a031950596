"""Memory that a flood of calls took goes back to the host. What is not glibc's does not know these calls."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import Any, Final

M_ARENA_MAX: Final = -8
ARENAS: Final = 2
"""Each of gRPC's threads would have one of its own, and what is free in one serves no other."""
FLOOD_CALLS: Final = 1000
"""So many refused calls are worth to look at the free memory."""
EVERY_S: Final = 5.0
AFTER_S: Final = 60.0


def limit_arenas() -> None:
    """Have all threads share few arenas; to be called before they start."""
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(M_ARENA_MAX, ARENAS)


class Trimmer:
    """Gives back what is free during floods, and for a while after them: gRPC frees what belongs to a call later."""

    def __init__(
        self, clock_s: Callable[[], float] = time.monotonic, trim: Callable[[int], object] | None = None
    ) -> None:
        self._clock_s = clock_s
        self._trim: Any = trim or getattr(ctypes.CDLL(None), "malloc_trim", int)
        self._seen = 0
        self._due_s = self._until_s = 0.0

    def look(self, refused: int) -> None:
        """``refused``: calls so far."""
        now_s = self._clock_s()
        if refused - self._seen >= FLOOD_CALLS:
            self._seen, self._until_s = refused, now_s + AFTER_S
        if self._due_s <= now_s < self._until_s:
            self._due_s = now_s + EVERY_S
            self._trim(0)
