"""Ctrl-C, SIGTERM and a closed terminal, for commands that run until they are told to stop, or are cut short."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that is set by the first of these signals; whoever heeded them before does so again afterwards.

    SIGHUP counts unless it is ignored, as by nohup.
    """
    stopping = threading.Event()

    def stop(_number: int, _frame: FrameType | None) -> None:
        # Not here: the main thread, which is interrupted, may hold the event's lock.
        threading.Thread(target=stopping.set, daemon=True).start()

    heeded = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        heeded.remove(signal.SIGHUP)
    old = {number: signal.signal(number, stop) for number in heeded}
    try:
        yield stopping
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


@contextmanager
def ended_by_interrupt() -> Iterator[None]:
    """Ctrl-C ends the process at once, and quietly: for imports of libraries that an exception within would break."""
    main = threading.current_thread() is threading.main_thread()
    heeded = main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heeded:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        if heeded:
            signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def exit_on_signals() -> Iterator[None]:
    """SIGTERM and a closed terminal end what is at work as Ctrl-C does, by an exception: nothing is left half done.

    The exit status is 128 + n, as shells have it. What was ignored, as SIGHUP is under nohup, still is.
    """

    def end(number: int, _frame: FrameType | None) -> None:
        for other in old:
            signal.signal(other, signal.SIG_IGN)  # a shell that ends tells it once more, and what is undone is undone
        sys.exit(128 + number)

    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    old = {number: handler for number, handler in handlers.items() if handler is not signal.SIG_IGN}
    for number in old:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
