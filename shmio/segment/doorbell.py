"""Doorbells in shared memory, on which processes wait, and relays, which wake event loops at each ring."""

from __future__ import annotations

import os
import threading
from typing import Final, Protocol

from shmio.segment import _atomics

TURN_NS: Final = 200_000_000
"""Maximum time in ns between two notifications of a relay.

At each notification, the programs that a relay wakes also check the age of frames, and look for
changes that ring no doorbell.
"""
_STOP_AGAIN_S: Final = 0.01
"""Interval in s at which :meth:`Relay.join` repeats its request, because the thread may miss one."""


class Doorbell:
    """A futex word in shared memory on which processes wait until another process rings.

    Only :meth:`ring` needs a writable mapping.
    """

    def __init__(self, memory: memoryview, offset: int) -> None:
        self._memory = memory
        self._offset = offset

    def value(self) -> int:
        """Return the present value. Read it before you check for changes."""
        return _atomics.bell(self._memory, self._offset)

    def ring(self) -> None:
        """Wake all waiters."""
        _atomics.bell_ring(self._memory, self._offset)

    def wait(self, seen: int, timeout_ns: int = -1) -> int:
        """Wait until the value differs from ``seen``, for at most ``timeout_ns`` (negative: forever).

        Returns:
            The value after the wait.
        """
        return _atomics.bell_wait(self._memory, self._offset, seen, timeout_ns)

    def relay(self, shared: bytearray, descriptor: int, turn_ns: int) -> None:
        """Make ``descriptor`` readable at each ring, until the relay is stopped.

        :class:`Relay` runs this in its thread.
        """
        _atomics.bell_relay(self._memory, self._offset, shared, descriptor, turn_ns)


class WakeSource(Protocol):
    """An object that a :class:`Relay` can wait for: a :class:`Doorbell`, or a ring with a doorbell."""

    def relay(self, shared: bytearray, descriptor: int, turn_ns: int, /) -> None:
        """Make ``descriptor`` readable at each ring, until the relay is stopped, without the GIL.

        Args:
            shared: Memory of ``RELAY_SIZE`` bytes, through which the relay stops this and clears the
                descriptor.
            descriptor: An eventfd.
            turn_ns: Maximum time in ns between two notifications.
        """


class Relay:
    """Wakes an event loop, through a file descriptor, when a doorbell rings.

    A thread waits for the doorbell without the GIL (``relay.h``). The thread makes ``descriptor``
    readable at the start, after each ring, and after ``turn_ns`` without a ring. The descriptor
    stays readable until the loop calls :meth:`acknowledge`.
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
        """True if the thread still runs."""
        return self._thread.is_alive()

    def acknowledge(self) -> None:
        """Make the descriptor unreadable until the next notification.

        Call this before you check for changes, so that you miss no change.
        """
        if not self._stopped:  # the descriptor may have been closed and reused
            _atomics.relay_heard(self._shared, self.descriptor)

    def stop(self) -> None:
        """Request that the thread stop. It ends within ``turn_ns``, and closes the descriptor."""
        self._stopped = True
        _atomics.relay_stop(self._shared)

    def join(self) -> None:
        """Stop the thread, and wait until it has ended, which takes at most ``turn_ns``."""
        while self._thread.is_alive():
            self.stop()
            self._thread.join(_STOP_AGAIN_S)

    def _run(self) -> None:
        try:
            self._word.relay(self._shared, self.descriptor, self._turn_ns)
        finally:
            os.close(self.descriptor)
