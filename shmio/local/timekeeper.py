"""Control an instance's time from a local program: step it, play it, release it."""

from __future__ import annotations

import threading
import time
from typing import Final

from shmio.errors import NotRunningError, ShmioError, TimeError, ValueRangeError
from shmio.local.replays import Replays
from shmio.local.time_control import Coordinator, Step, check_step
from shmio.model.clock import Clock
from shmio.segment.segment import Segment

PATIENCE_S: Final = 2.0
"""How long to wait for the owner of time to give it up; the gRPC endpoint does when its clients are idle."""
LATE_NS: Final = 500_000_000
"""Playing catches up with at most this much delay."""


class Timekeeper:
    """Steps or plays an instance's time, and owns that time from the first step until it is closed.

    Use it from one thread; it plays in a thread of its own.
    """

    def __init__(self, segment: Segment) -> None:
        """``segment`` must be writable."""
        self._segment = segment
        self._coordinator = Coordinator(segment)
        self._paused = threading.Event()
        self._player: threading.Thread | None = None
        self._failure: ShmioError | None = None

    def step(self, dt_ns: int | None = None) -> Step:
        """Move time by one step, as :meth:`Coordinator.step` does. TimeError: also while time is played."""
        if self._player is not None:
            raise TimeError("time is playing: pause it before you step it")
        self._take_over()
        return self._coordinator.step(dt_ns)

    def play(self, rate: float = 1.0, dt_ns: int | None = None) -> None:
        """Step in a thread, ``rate`` times as fast as real time. TimeError, ValueRangeError."""
        if dt_ns is not None:
            check_step(dt_ns)
        self.pause()
        self._coordinator.set_playing(True, rate)
        self._paused.clear()
        self._player = threading.Thread(target=self._play, args=(rate, dt_ns), name="player", daemon=True)
        self._player.start()

    def pause(self) -> None:
        """Stop playing, and take over time if this program does not own it.

        Raises:
            TimeError: Another program owns time, or a step failed while time was played.
        """
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
        """Return to real time. TimeError: also if a step failed while time was played."""
        self._check_running()
        self._coordinator.check_release()
        if self._player is not None:
            self.pause()
        self._coordinator.release(PATIENCE_S)

    def close(self) -> None:
        """Stop playing, and give up the ownership of time."""
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
    """The methods of an attachment that control time and replays."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._time = Timekeeper(segment)
        self.replay = Replays(segment)
        """The instance's replays: call it as ``replay`` of :class:`shmio.Cell`, or use its methods.

        The attachment must be ``writable`` to change them.
        """

    @property
    def clock(self) -> Clock:
        """State of the instance's clock: wall time, or virtual time with its last step.

        It may be called, as ``clock()`` of :class:`shmio.Cell`.
        """
        return self._segment.clock.read()

    def step(self, dt_s: float | None = None, count: int = 1) -> Clock:
        """Move time by steps, and wait until all sources that use the instance clock have done them.

        The first call of this method, :meth:`pause` or :meth:`play` takes over time: from then on only
        steps move it. This program owns time until it detaches or calls :meth:`release`.
        The attachment must be ``writable``.

        Args:
            dt_s: Length of each step in s, from 1 us to 1 h; None: the step size.
            count: Number of steps.

        Returns:
            The state of the clock after the last step.

        Raises:
            TimeError: Another program owns time, or the step failed; the message says who failed or
                did not answer.
            ValueRangeError: The length is not within 1 us and 1 h, or the number is below 1.
        """
        dt_ns = _ns(dt_s)
        if count < 1:
            raise ValueRangeError(f"the number of steps must be at least 1, not {count}")
        for _ in range(count):
            self._time.step(dt_ns)
        return self.clock

    def play(self, rate: float = 1.0, dt_s: float | None = None) -> Clock:
        """Step time in a thread until :meth:`pause`; returns the state of the clock.

        Args:
            rate: How many times as fast as real time; above 0, at most 1000.
            dt_s: Length of a step in s; None: the step size.

        Raises:
            TimeError: Another program owns time.
            ValueRangeError: The rate or the length is out of range.
        """
        self._time.play(rate, _ns(dt_s))
        return self.clock

    def pause(self) -> Clock:
        """Stop time until it is stepped or played; returns the state of the clock.

        Raises:
            TimeError: Another program owns time, or a step failed while time was played.
        """
        self._time.pause()
        return self.clock

    def release(self) -> Clock:
        """Return to real time, which goes on from the present virtual time; returns the state of the clock.

        This program gives up the ownership of time. If time is real, nothing happens.

        Raises:
            TimeError: Another program owns time, time was virtual from the instance's start, or a
                step failed while time was played.
        """
        self._time.release()
        return self.clock


def _ns(dt_s: float | None) -> int | None:
    """Check the length of a step, and convert it to ns; ValueRangeError."""
    if dt_s is None:
        return None
    check_step(dt_s * 1e9)  # before rounding, which fails for infinity
    return round(dt_s * 1e9)
