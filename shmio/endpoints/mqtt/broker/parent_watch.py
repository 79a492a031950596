"""Runs a program that ends when its parent process ends.

Usage: ``parent_watch PARENT PROGRAM [ARGUMENT...]``. PARENT is the id of the parent process, which
runs this command.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

_PR_SET_PDEATHSIG: Final = 1  # prctl(2)


def main() -> None:
    """Replace this process by the program, or exit if the parent has already ended."""
    parent, program = int(sys.argv[1]), sys.argv[2]
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() == parent:
        os.execv(program, sys.argv[2:])  # noqa: S606  to run this program is the purpose


if __name__ == "__main__":
    main()
