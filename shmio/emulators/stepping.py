"""Lets an emulated device follow the instance's clock: each step runs the scans that are due in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from shmio.emulators.cycle import Cycle
from shmio.errors import SnapshotError
from shmio.segment.clock import ClockPage

_PART_NS: Final = 1_000_000_000
"""A long step is computed in parts of this length, with a heartbeat after each."""


class InstanceTime:
    """Lets the program of an emulated device follow the instance's clock. Use it from one thread.

    In wall time the program keeps its own schedule. In virtual time the program stands still
    between steps, and each step runs the scans that are due. The scans run once all sources have
    completed the step, and the step ends only after the scans.
    """

    def __init__(self, page: ClockPage, slot: int, cycle: Cycle, beat: Callable[[], object]) -> None:
        """Start to follow the clock. From now on, each step waits for the scans.

        Args:
            page: The clock page.
            slot: Index of the process's slot.
            cycle: The program's cycle.
            beat: Sends a heartbeat.

        """
        self._page, self._slot, self._cycle, self._beat = page, slot, cycle, beat
        self._time_ns: int | None = None  # instance time up to which scans have run; None in wall time
        self._step = 0
        state = page.read()
        if state.virtual:
            self._cycle.freeze()
            self._time_ns, self._step = state.present_ns, state.done
        page.deliver(slot, self._step)

    def follow(self) -> None:
        """Run the scans that are due, and report the step as delivered. Call this when the clock changes."""
        state = self._page.read()
        if not state.virtual:
            if self._time_ns is not None:
                self._time_ns = None
                self._cycle.thaw()
            return
        if self._time_ns is None:
            self._cycle.freeze()
            # On a busy machine, the first step may be done already; it still waits for its scans.
            first = bool(state.dt_ns) and not state.stepping
            self._time_ns = state.present_ns - first * state.dt_ns
            self._step = state.step - (first or state.stepping)
        if not state.stepping and state.step > self._step and state.dt_ns:  # 0: a snapshot is being restored
            self._advance(state.time_ns - self._time_ns)
            self._time_ns, self._step = state.time_ns, state.step
            if self._cycle.failure is None:  # else the process ends
                self._page.deliver(self._slot, state.step)

    @property
    def place(self) -> tuple[int, int]:
        """The step and the instance time in ns up to which scans have run.

        Raises:
            SnapshotError: The program has not yet stopped for virtual time.

        """
        if self._time_ns is None:
            raise SnapshotError("its program has not stopped yet")
        return self._step, self._time_ns

    def jump(self, step: int, time_ns: int) -> None:
        """Continue from the step and time of a snapshot, and report that step as delivered."""
        self._step, self._time_ns = step, time_ns
        self._page.deliver(self._slot, step)

    def close(self) -> None:
        """Stop following the clock, so that later steps do not wait for this process."""
        self._page.abstain(self._slot)

    def _advance(self, dt_ns: int) -> None:
        while dt_ns > 0 and self._cycle.failure is None:
            part_ns = min(dt_ns, _PART_NS)
            self._cycle.advance(part_ns)
            dt_ns -= part_ns
            self._beat()
