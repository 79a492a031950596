"""Memory that a flood of calls took goes back to the host. What is not glibc's does not know these calls."""

from __future__ import annotations

import ctypes
from typing import Final

M_ARENA_MAX: Final = -8
ARENAS: Final = 2
"""Each of gRPC's threads would have one of its own, and what is free in one serves no other."""
TRIM_CALLS: Final = 1000
"""So many refused calls between two looks at the free memory, at least."""


def limit_arenas() -> None:
    """Have all threads share few arenas; to be called before they start."""
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(M_ARENA_MAX, ARENAS)


class Trimmer:
    """Gives back what is free after floods."""

    def __init__(self) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._before = 0
        self._trimmed = 0

    def look(self, refused: int) -> None:
        """``refused``: calls so far. Once a flood is over, its memory is free."""
        over, self._before = refused == self._before, refused
        if over and refused - self._trimmed >= TRIM_CALLS and self._trim is not None:
            self._trimmed = refused
            self._trim(0)
