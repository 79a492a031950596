"""Checks memory and descriptors of long-running processes, which must not grow without limit."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from tests.faults.checks import Complain

MOST_GROWTH_MB: Final = 100.0
MOST_DESCRIPTORS: Final = 500
"""Maximum number of descriptors, far more than such an instance needs with all its clients."""

_PAGE_MB: Final = os.sysconf("SC_PAGE_SIZE") / 1e6


class Resources:
    """Measures processes from time to time."""

    def __init__(self, complain: Complain) -> None:
        self._complain = complain
        self._first: dict[tuple[str, int], float] = {}
        self.peaks: dict[str, tuple[float, int]] = {}

    def look(self, pids: Mapping[str, int | None]) -> None:
        """Measure the present processes, given by name."""
        present = {(name, pid) for name, pid in pids.items() if pid is not None}
        self._first = {key: first for key, first in self._first.items() if key in present}
        for name, pid in present:
            try:
                private_mb = _private_mb(pid)
                descriptors = len(list(Path(f"/proc/{pid}/fd").iterdir()))
            except OSError:
                continue  # it has just ended
            self.note(name, pid, private_mb, descriptors)

    def note(self, name: str, pid: int, private_mb: float, descriptors: int) -> None:
        """Check what one process uses now."""
        first_mb = self._first.setdefault((name, pid), private_mb)
        peak = self.peaks.get(name, (0.0, 0))
        self.peaks[name] = (max(peak[0], private_mb), max(peak[1], descriptors))
        if private_mb > first_mb + MOST_GROWTH_MB:
            self._complain(f"{name}, pid {pid}, grew from {first_mb:.0f} to {private_mb:.0f} MB")
        if descriptors > MOST_DESCRIPTORS:
            self._complain(f"{name}, pid {pid}, has {descriptors} descriptors open")


def _private_mb(pid: int) -> float:
    """Return resident minus shared memory in MB; see proc_pid_statm(5)."""
    _, resident, shared = Path(f"/proc/{pid}/statm").read_text().split()[:3]
    return (int(resident) - int(shared)) * _PAGE_MB
