"""Handle Ctrl-C, SIGTERM and a closed terminal in commands that run for a long time."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """Yield an event that the first of these signals sets; restore the handlers at the end.

    SIGHUP counts unless it is ignored, as by nohup.
    """
    stopping = threading.Event()

    def stop(_number: int, _frame: FrameType | None) -> None:
        # In another thread, because the interrupted main thread may hold the event's lock.
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
    """Let Ctrl-C end the process at once and quietly, for imports that an exception would break."""
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
    """Let SIGTERM and SIGHUP raise SystemExit, so that unfinished work is undone.

    The exit status is 128 + n, as in shells. Ignored signals, such as SIGHUP under nohup, stay
    ignored.
    """

    def end(number: int, _frame: FrameType | None) -> None:
        for other in old:
            signal.signal(other, signal.SIG_IGN)  # an ending shell repeats it, and must not disturb the undoing
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
