"""Ends a process when its parent process ends, however that happens."""

from __future__ import annotations

import ctypes
import os
import signal
from typing import Final

_PR_SET_PDEATHSIG: Final = 1  # prctl(2)


def end_with_parent(parent: int) -> bool:
    """Let the kernel end this process with SIGKILL when its parent ends.

    Args:
        parent: Id of the parent process, as the parent knows it.

    Returns:
        False if the parent has already ended.

    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent
