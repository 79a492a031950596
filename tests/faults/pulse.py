"""Measures the machine's load: waits for a processor, and how much longer work takes."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import Final

PULSE_S: Final = 0.05
REMEMBERED: Final = 200
"""Number of measurements that are kept: those of 10 s or more."""
LEAST_NS: Final = 20_000_000
"""Minimum CPU time from which :attr:`Pulse.slowness` is computed."""


class Pulse:
    """Measures the load of the machine as this process feels it. One thread calls :meth:`beat`; others may read."""

    def __init__(self) -> None:
        self._held_up_ns: deque[int] = deque([0], maxlen=REMEMBERED)
        self._worked: deque[tuple[int, int]] = deque([_worked()], maxlen=REMEMBERED)

    def beat(self) -> None:
        """Sleep for :data:`PULSE_S`, and measure."""
        due_ns = time.monotonic_ns() + round(PULSE_S * 1e9)
        time.sleep(PULSE_S)
        self._held_up_ns.append(max(0, time.monotonic_ns() - due_ns))
        self._worked.append(_worked())

    @property
    def held_up_ns(self) -> int:
        """Longest recent wait of a thread for a processor, in ns."""
        return max(self._held_up_ns)

    @property
    def slowness(self) -> float:
        """Factor by which recent work took longer than on an idle machine; at least 1.

        :attr:`held_up_ns` is not enough: a thread that mostly sleeps soon gets a processor, even
        on a loaded machine.
        """
        (run_ns, wait_ns), (ran_ns, waited_ns) = self._worked[0], self._worked[-1]
        if ran_ns - run_ns < LEAST_NS or waited_ns < wait_ns:  # the figures of ended threads are missing
            return 1.0
        return 1.0 + (waited_ns - wait_ns) / (ran_ns - run_ns)


def waited_ns(pid: int) -> int:
    """Return how many ns the threads of a process have waited for a processor; those that have ended do not count."""
    return _worked(str(pid))[1]


def _worked(pid: str = "self") -> tuple[int, int]:
    """Return how many ns a process's threads have run, and have waited for a processor."""
    run_ns = wait_ns = 0
    for figures in Path("/proc").glob(f"{pid}/task/*/schedstat"):
        try:
            run, wait, _ = figures.read_text().split()
        except (OSError, ValueError):
            continue  # the thread has just ended, or the kernel has no figures
        run_ns += int(run)
        wait_ns += int(wait)
    return run_ns, wait_ns
