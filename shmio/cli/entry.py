"""The console scripts. They import next to nothing, so that Ctrl-C while a command is still loading is no traceback."""

from __future__ import annotations

import importlib
import sys


def shmio() -> int:
    """``shmio``."""
    return _run("shmio.cli.user")


def shmio_dump() -> int:
    """``shmio-dump``."""
    return _run("shmio.cli.dump")


def shmio_layout() -> int:
    """``shmio-layout``."""
    return _run("shmio.cli.layout")


def shmio_supervisor() -> int:
    """``shmio-supervisor``."""
    return _run("shmio.cli.supervisor")


def _run(module: str) -> int:
    """The exit status of this module's ``main``: 130 if it was interrupted before that heeds Ctrl-C."""
    try:
        status: int = importlib.import_module(module).main(sys.argv[1:])
    except KeyboardInterrupt:
        return 130
    return status
