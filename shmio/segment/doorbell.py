"""Turn a doorbell in shared memory into a readable descriptor, for event loops, which cannot wait on a futex."""

from __future__ import annotations

import os
import threading
from typing import Final, Protocol

from shmio.segment import _atomics

TURN_NS: Final = 200_000_000
"""Longest time between two notifications: listeners also check ages, and changes that ring no doorbell."""
AGAIN_S: Final = 0.01
"""How often a thread is told to stop until it has ended: one about to wait may miss the request."""


class WakeSource(Protocol):
    """A doorbell: :class:`~shmio.segment.clock.Doorbell`, or that of a ring."""

    def relay(self, shared: bytearray, descriptor: int, turn_ns: int, /) -> None:
        """Wait for rings and signal the descriptor until stopped, without the interpreter's lock."""


class Relay:
    """Signals the rings of a doorbell through a descriptor.

    A thread that never holds the interpreter's lock waits for the doorbell (``relay.h``). The
    ``descriptor`` is readable at first, after each ring, and after ``turn_ns`` without one, until
    :meth:`heard` is called.
    """

    def __init__(self, word: WakeSource, name: str, turn_ns: int = TURN_NS) -> None:
        self.descriptor = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._shared = bytearray(_atomics.RELAY_SIZE)
        self._word = word
        self._turn_ns = turn_ns
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread still runs."""
        return self._thread.is_alive()

    def heard(self) -> None:
        """Acknowledge a notification. Call it before you check for changes, so that later rings are signalled."""
        if not self._stopped:  # the descriptor may have been closed and reused
            _atomics.relay_heard(self._shared, self.descriptor)

    def stop(self) -> None:
        """Stop signalling. The thread ends within ``turn_ns``, and closes the descriptor."""
        self._stopped = True
        _atomics.relay_stop(self._shared)

    def join(self) -> None:
        """Stop, and wait until the thread has ended, which takes less than ``turn_ns``."""
        while self._thread.is_alive():
            self.stop()
            self._thread.join(AGAIN_S)

    def _run(self) -> None:
        try:
            self._word.relay(self._shared, self.descriptor, self._turn_ns)
        finally:
            os.close(self.descriptor)
