"""Runs a program that ends when its parent process ends.

Usage: ``parent_watch PARENT PROGRAM [ARGUMENT...]``. PARENT is the id of the parent process, which
runs this command.
"""

from __future__ import annotations

import os
import sys

from shmio.parent import end_with_parent


def main() -> None:
    """Replace this process by the program; exit instead if the parent has already ended."""
    parent, program = int(sys.argv[1]), sys.argv[2]
    if end_with_parent(parent):
        os.execv(program, sys.argv[2:])  # noqa: S606  to run this program is the purpose


if __name__ == "__main__":
    main()
