"""Ctrl-C, SIGTERM and a closed terminal, for commands that run until they are told to stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def told_to_stop() -> Iterator[threading.Event]:
    """An event that is set by the first of these signals; whoever heeded them before does so again afterwards."""
    stopping = threading.Event()

    def stop(_number: int, _frame: FrameType | None) -> None:
        # Not here: the main thread, which is interrupted, may hold the event's lock.
        threading.Thread(target=stopping.set, daemon=True).start()

    old = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield stopping
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
