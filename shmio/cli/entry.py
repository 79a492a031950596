"""The console scripts. They import little at first, so that Ctrl-C ends a command at once while it loads.

Ctrl-C does not raise an exception while the command loads. An exception during an import would
leave a library half loaded, and C code that uses such a library crashes.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from types import TracebackType

from shmio import garbage


def _hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print the traceback of an uncaught error, except for Ctrl-C."""
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _hook
_HEEDED = signal.getsignal(signal.SIGINT) is signal.default_int_handler
if _HEEDED:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # until the command begins


def shmio() -> int:
    """Run the command ``shmio``."""
    return _run("shmio.cli.user")


def shmio_campaign() -> int:
    """Run the command ``shmio-campaign``."""
    return _run("shmio.cli.campaign")


def shmio_dump() -> int:
    """Run the command ``shmio-dump``."""
    return _run("shmio.cli.dump")


def shmio_layout() -> int:
    """Run the command ``shmio-layout``."""
    return _run("shmio.cli.layout")


def shmio_supervisor() -> int:
    """Run the command ``shmio-supervisor``."""
    return _run("shmio.cli.supervisor")


def _run(module: str) -> int:
    """Run a module's ``main`` and return its exit status.

    The status is 130 if Ctrl-C interrupts it.
    """
    try:
        with garbage.paused():
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
    """Exit without shutting the interpreter down: gRPC's threads may crash or hang in that phase."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            status = status or 1
    os._exit(status)


def _end_quietly() -> None:
    """Let Ctrl-C end the process at once, without printing a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
