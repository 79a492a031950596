"""The console scripts. They import next to nothing: Ctrl-C while a command is still loading ends it at once.

Not by an exception: one within the import of a library leaves half of it, and C code that goes on with that crashes.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from types import TracebackType


def _hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """What the script shows of an error that ends it: nothing of Ctrl-C, by which it ends as shells expect."""
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _hook
_HEEDED = signal.getsignal(signal.SIGINT) is signal.default_int_handler
if _HEEDED:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # until the command begins


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
        main = importlib.import_module(module).main
        if _HEEDED:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        status: int = main(sys.argv[1:])
    except KeyboardInterrupt:
        return 130
    finally:
        _end_quietly()
    if "grpc" in sys.modules:
        _leave(status)
    return status


def _leave(status: int) -> None:
    """End without the interpreter's own end, in which threads of gRPC that still run may crash, or wait for ever."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            status = status or 1
    os._exit(status)


def _end_quietly() -> None:
    """Have Ctrl-C end the process at once: nothing is left to be told, and the interpreter would print a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
