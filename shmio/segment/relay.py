"""For event loops, which cannot wait on a futex: a descriptor that a bell in shared memory makes readable."""

from __future__ import annotations

import os
import threading
from typing import Final, Protocol

from shmio.segment import _atomics

TURN_NS: Final = 200_000_000
"""Longest time between two tellings: who listens looks at the age of what there is, and at what rings no bell."""
AGAIN_S: Final = 0.01
"""So often a thread is told to stop until it has ended: one that is just about to wait does not notice."""


class WakeSource(Protocol):
    """A bell: :class:`~shmio.segment.clock.Doorbell`, or the doorbell of a ring."""

    def relay(self, shared: bytearray, descriptor: int, turn_ns: int, /) -> None:
        """Wait for it, and tell, until it is stopped; without the interpreter's lock."""


class Relay:
    """Tells of the rings of one bell, from a thread of its own that never holds the interpreter's lock (``relay.h``).

    ``descriptor`` is readable at first, after each ring, and after ``turn_ns`` without one, until :meth:`heard`.
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
        """Whether it tells, or is about to end."""
        return self._thread.is_alive()

    def heard(self) -> None:
        """To be called when the descriptor is readable, before looking: what comes from then on is told again."""
        if not self._stopped:  # the descriptor's number may be another's by now
            _atomics.relay_heard(self._shared, self.descriptor)

    def stop(self) -> None:
        """Tell no more. The thread ends soon, within ``turn_ns``, and the descriptor with it."""
        self._stopped = True
        _atomics.relay_stop(self._shared)

    def join(self) -> None:
        """Stop, and wait until the thread has ended; that takes no ``turn_ns``."""
        while self._thread.is_alive():
            self.stop()
            self._thread.join(AGAIN_S)

    def _run(self) -> None:
        try:
            self._word.relay(self._shared, self.descriptor, self._turn_ns)
        finally:
            os.close(self.descriptor)
