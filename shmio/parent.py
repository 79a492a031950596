"""Ends a process when its parent process ends, even if the parent is killed."""

from __future__ import annotations

import ctypes
import os
import signal
from typing import Final

_PR_SET_PDEATHSIG: Final = 1  # prctl(2)


def end_with_parent(parent: int) -> bool:
    """Let the kernel end this process with SIGKILL when its parent ends.

    Args:
        parent: Pid of the parent process, which the parent has passed on.

    Returns:
        False if the parent has already ended.

    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent
