"""How the machine treats us: how long it keeps waiting who wants to run, and how much slower it makes who works."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import Final

PULSE_S: Final = 0.05
REMEMBERED: Final = 200
"""Pulses, 10 s of them and more."""
LEAST_NS: Final = 20_000_000
"""Of less work nothing is concluded."""


class Pulse:
    """Measures both for the process it is in; for one thread, other threads may look."""

    def __init__(self) -> None:
        self._held_up_ns: deque[int] = deque([0], maxlen=REMEMBERED)
        self._worked: deque[tuple[int, int]] = deque([_worked()], maxlen=REMEMBERED)

    def beat(self) -> None:
        """Sleep for a pulse, and take note."""
        due_ns = time.monotonic_ns() + round(PULSE_S * 1e9)
        time.sleep(PULSE_S)
        self._held_up_ns.append(max(0, time.monotonic_ns() - due_ns))
        self._worked.append(_worked())

    @property
    def held_up_ns(self) -> int:
        """The longest that a thread that wanted to run was lately kept waiting."""
        return max(self._held_up_ns)

    @property
    def slowness(self) -> float:
        """How many times longer work has lately taken than on an idle machine; at least 1.

        Who sleeps most of the time is woken at once on a loaded machine too, so :attr:`held_up_ns` does not show it.
        """
        (run_ns, wait_ns), (ran_ns, waited_ns) = self._worked[0], self._worked[-1]
        if ran_ns - run_ns < LEAST_NS or waited_ns < wait_ns:  # a thread that has ended takes its figures with it
            return 1.0
        return 1.0 + (waited_ns - wait_ns) / (ran_ns - run_ns)


def _worked() -> tuple[int, int]:
    """For how many ns the threads of this process have run, and waited for a processor."""
    run_ns = wait_ns = 0
    for task in Path("/proc/self/task").iterdir():
        try:
            run, wait, _ = (task / "schedstat").read_text().split()
        except (OSError, ValueError):
            continue  # it has just ended, or the kernel does not tell
        run_ns += int(run)
        wait_ns += int(wait)
    return run_ns, wait_ns
