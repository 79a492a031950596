"""Signals as events of a selector: they wake it, and nothing is done in a handler."""

from __future__ import annotations

import selectors
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def wake_on_signals(selector: selectors.BaseSelector, on_signal: Callable[[int], None]) -> Iterator[None]:
    """Have ``on_signal`` called for SIGINT, SIGTERM and SIGHUP from the selector's loop.

    SIGHUP counts unless it is ignored, as by nohup.
    """
    receiver, sender = socket.socketpair()
    with receiver, sender:
        receiver.setblocking(False)
        sender.setblocking(False)

        def receive() -> None:
            for number in receiver.recv(64):
                on_signal(number)

        selector.register(receiver, selectors.EVENT_READ, receive)
        old_fd = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        heeded = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
        if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
            heeded.remove(signal.SIGHUP)
        old = {sign: signal.signal(sign, _wake) for sign in heeded}
        try:
            yield
        finally:
            for sign, handler in old.items():
                signal.signal(sign, handler)
            signal.set_wakeup_fd(old_fd)
            selector.unregister(receiver)


def _wake(_number: int, _frame: FrameType | None) -> None:
    """A handler must exist for the wake-up descriptor to be written."""
