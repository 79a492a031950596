"""Watches how fast an axis of a robot turns."""

from __future__ import annotations

from collections import deque

from shmio.simulation import Input, Model, Output

STEPS = 10  # the speed is the mean over so many steps, because the axis is read by another clock than the guard's


class SpeedGuard(Model):
    """Reports an axis that turns faster than the limit."""

    axis = Input("REAL", unit="deg")
    limit = Input("LREAL", 100.0, unit="deg/s", limits=(1.0, 360.0))
    speed = Output("LREAL", unit="deg/s")
    too_fast = Output("BOOL")
    trips = Output("DINT", comment="how often the axis has become too fast")

    def start(self) -> None:
        """Forget all positions."""
        self._positions: deque[float] = deque(maxlen=STEPS + 1)

    def step(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002
        """Compare the position with that of ten steps ago."""
        self._positions.append(self.axis)
        if len(self._positions) > STEPS:
            self.speed = abs(self._positions[-1] - self._positions[0]) / (STEPS * dt_s)
        too_fast = self.speed > self.limit
        self.trips += too_fast and not self.too_fast
        self.too_fast = too_fast
