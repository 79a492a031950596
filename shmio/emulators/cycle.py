"""Runs the cycles of an emulated device's program in a thread, on an absolute schedule."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Cycle:
    """Runs a program's step in each period. Start it once.

    The schedule is absolute, so the cycles do not drift; late cycles are skipped and counted. A cycle
    is followed by a pause of at least its own length, so that a slow program leaves the device half
    of the time to answer its clients.

    While the cycle is frozen, the schedule stands still, and :meth:`advance` moves the program's time.
    """

    def __init__(
        self, period_s: float, step: Callable[[float], object], name: str, active: Callable[[], bool] = lambda: True
    ) -> None:
        """Prepare the cycle.

        Args:
            period_s: Time between two cycles, in s.
            step: Runs one cycle, given the program's time in s.
            name: Name of the thread.
            active: Returns whether the device runs its program. While it does not, the program's
                time stands still.

        """
        self._period_s, self._step, self._active = period_s, step, active
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._stopping = threading.Event()
        self._free = threading.Event()  # cleared while the cycle is frozen
        self._free.set()
        self._turn = threading.Lock()  # held during a cycle
        self._number = 0  # of the last cycle; skipped cycles are counted as well
        self._owed_ns = 0  # time since the last cycle of a frozen program
        self.failure: Exception | None = None
        """Error that ended the program, or None; the emulator's process checks it regularly."""
        self.cycles = 0
        """Number of cycles that have run."""
        self.overruns = 0
        """Number of cycles skipped because the previous one took too long."""

    def first(self) -> None:
        """Run the first cycle. Call this before clients can connect to the device."""
        self._step(0)
        self.cycles += 1

    def start(self) -> None:
        """Start the thread that runs all further cycles."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread; return when it has ended."""
        self._stopping.set()
        self._free.set()
        if self._thread.ident is not None:
            self._thread.join()

    def freeze(self) -> None:
        """Stop the schedule; return when the present cycle has ended."""
        self._free.clear()
        with self._turn:
            self._owed_ns = 0

    def thaw(self) -> None:
        """Continue the schedule, beginning with a cycle one period from now."""
        self._free.set()

    def advance(self, dt_ns: int) -> None:
        """Run the cycles of a frozen program that are due in the next ``dt_ns``; store an error in ``failure``.

        A remaining part of a period counts for the next call.
        """
        period_ns = round(self._period_s * 1e9)
        with self._turn:
            self._owed_ns += dt_ns
            try:
                while self._owed_ns >= period_ns and self.failure is None:
                    self._owed_ns -= period_ns
                    if self._active():
                        self._scan(0)
            except Exception as error:  # noqa: BLE001 - the process reports defects of the program
                self.failure = error

    @contextmanager
    def held(self) -> Iterator[None]:
        """Prevent cycles from running during a ``with`` block."""
        with self._turn:
            yield

    @property
    def position(self) -> tuple[int, int]:
        """Number of the last cycle, and the time since then in ns. Set it only while the program is frozen."""
        return self._number, self._owed_ns

    @position.setter
    def position(self, position: tuple[int, int]) -> None:
        self._number, self._owed_ns = position

    def _scan(self, skipped: int) -> None:
        self._number += skipped + 1
        self._step(self._number * self._period_s)
        self.cycles += 1

    def _run(self) -> None:
        begun_s = free_s = time.monotonic()
        tick = 0
        try:
            while True:
                if not self._free.is_set():
                    self._free.wait()
                    begun_s = free_s = time.monotonic()
                    tick = 0
                elapsed = int((time.monotonic() - begun_s) / self._period_s)
                missed = max(0, elapsed - tick - 1)
                tick += missed + 1
                if self._stopping.wait(max(begun_s + tick * self._period_s, free_s) - time.monotonic()):
                    return
                with self._turn:
                    if self._free.is_set() and self._active():
                        self.overruns += missed
                        step_s = time.monotonic()
                        self._scan(missed)
                        free_s = 2 * time.monotonic() - step_s
        except Exception as error:  # noqa: BLE001 - the process reports defects of the program
            self.failure = error
