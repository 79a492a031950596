"""The console scripts. They import next to nothing, so that Ctrl-C while a command is still loading is no traceback."""

from __future__ import annotations

import importlib
import signal
import sys
from types import TracebackType


def _hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """What the script shows of an error that ends it: nothing of Ctrl-C, by which it ends as shells expect."""
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _hook  # first: all that follows may be interrupted, this module's imports too


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
    finally:
        _end_quietly()
    return status


def _end_quietly() -> None:
    """Have Ctrl-C end the process at once: nothing is left to be told, and the interpreter would print a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
