"""How a local program moves an instance's time: step by step, or at a pace."""

from __future__ import annotations

import threading
import time
from typing import Final

from shmio.errors import NotRunningError, ShmioError, TimeError
from shmio.local.replays import Replays
from shmio.local.time_control import Coordinator, Step, check_step
from shmio.segment.clock import ClockState
from shmio.segment.segment import Segment

PATIENCE_S: Final = 2.0
"""So long is waited for a program that owns time to give it up; the gRPC endpoint does when its clients rest."""
LATE_NS: Final = 500_000_000
"""What is late is caught up with, up to this."""


class Timekeeper:
    """Owns time from the first step on until it is closed. For one thread, beside which it plays in one of its own."""

    def __init__(self, segment: Segment) -> None:
        """``segment``: writable."""
        self._segment = segment
        self._coordinator = Coordinator(segment)
        self._paused = threading.Event()
        self._player: threading.Thread | None = None
        self._failure: ShmioError | None = None

    def step(self, dt_ns: int | None = None) -> Step:
        """See :meth:`Coordinator.step`. TimeError, too, while time is played."""
        if self._player is not None:
            raise TimeError("time is played: pause it before it can be stepped")
        self._take_over()
        return self._coordinator.step(dt_ns)

    def play(self, rate: float = 1.0, dt_ns: int | None = None) -> None:
        """Step from now on by itself, ``rate`` times as fast as real time. TimeError, ValueRangeError."""
        if dt_ns is not None:
            check_step(dt_ns)
        self.pause()
        self._coordinator.set_playing(True, rate)
        self._paused.clear()
        self._player = threading.Thread(target=self._play, args=(rate, dt_ns), name="player", daemon=True)
        self._player.start()

    def pause(self) -> None:
        """Have time stand; take it over if need be. TimeError, too, of a step that has failed while it was played."""
        self._take_over()
        player, self._player = self._player, None
        if player is not None:
            self._paused.set()
            player.join()
        self._coordinator.set_playing(False)
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def release(self) -> None:
        """Have time be real again. TimeError, also of a step that has failed while it was played."""
        self._check_running()
        self._coordinator.check_release()
        if self._player is not None:
            self.pause()
        self._coordinator.release(PATIENCE_S)

    def close(self) -> None:
        """Stop playing, and give time up."""
        try:
            if self._player is not None:
                self.pause()
        finally:
            self._coordinator.close()

    def _take_over(self) -> None:
        self._check_running()
        self._coordinator.take_over(PATIENCE_S)

    def _check_running(self) -> None:
        if not self._segment.shared.current():
            raise NotRunningError(f"instance {self._segment.instance!r} has stopped")

    def _play(self, rate: float, dt_ns: int | None) -> None:
        due_ns = time.monotonic_ns()
        while not self._paused.is_set():
            try:
                step = self._coordinator.step(dt_ns)
            except ShmioError as error:
                self._failure = error
                self._coordinator.set_playing(False)
                return
            now_ns = time.monotonic_ns()
            due_ns = max(due_ns + round(step.dt_ns / rate), now_ns - LATE_NS)
            self._paused.wait(max(0, due_ns - now_ns) / 1e9)


class TimeMethods:
    """The part of an attachment that has to do with time."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._time = Timekeeper(segment)
        self.replay = Replays(segment)
        """What plays recordings, and moves them; the attachment must be ``writable`` to do more than look."""

    @property
    def clock(self) -> ClockState:
        """The instance's clock as it is now: wall time, or virtual time with its last step."""
        return self._segment.clock.read()

    def step(self, dt_s: float | None = None) -> Step:
        """Move time by ``dt_s`` (default: the step size), and wait until all sources on the clock have done so.

        From the first call on, of this or :meth:`pause` or :meth:`play`, only steps move time; this program owns it
        until it detaches, or calls :meth:`release`. The attachment must be ``writable``. TimeError: another program
        owns time, or the step failed: who did not answer or failed, and why; ValueRangeError: not within 1 us and 1 h.
        """
        return self._time.step(_ns(dt_s))

    def play(self, rate: float = 1.0, dt_s: float | None = None) -> None:
        """Step from now on ``rate`` times as fast as real time, until :meth:`pause`. TimeError, ValueRangeError."""
        self._time.play(rate, _ns(dt_s))

    def pause(self) -> None:
        """Have time stand. TimeError: another program owns it, or a step failed while it was played."""
        self._time.pause()

    def release(self) -> None:
        """Have time be real again: it goes on from where it stands, and this program owns it no more.

        Nothing, if it is real. TimeError: another program owns time, it was virtual from the instance's start, or a
        step failed while it was played.
        """
        self._time.release()


def _ns(dt_s: float | None) -> int | None:
    """The length of a step; ValueRangeError."""
    if dt_s is None:
        return None
    check_step(dt_s * 1e9)  # before it is made a whole number: infinity is none
    return round(dt_s * 1e9)
