"""Ends a process when its parent process ends, even if the parent is killed.

``python -m shmio.parent PARENT PROGRAM [ARGUMENT...]`` runs a program that ends so. PARENT is the id
of the parent process, which runs this command.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
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


def main() -> None:
    """Replace this process by the program, or exit if the parent has already ended."""
    parent, program = int(sys.argv[1]), sys.argv[2]
    if end_with_parent(parent):
        os.execv(program, sys.argv[2:])  # noqa: S606  to run this program is the purpose


if __name__ == "__main__":
    main()
