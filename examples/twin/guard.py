"""Watches how fast an axis of a robot turns."""

from __future__ import annotations

from collections import deque

from shmio.simulation import Input, Model, Output

WINDOW_S = 0.2  # the speed is the mean over this time, because the controller's cycle and the guard's differ


class SpeedGuard(Model):
    """Reports an axis that turns faster than the limit."""

    axis = Input("REAL", unit="deg")
    limit = Input("LREAL", 150.0, unit="deg/s", limits=(1.0, 360.0))
    speed = Output("LREAL", unit="deg/s")
    too_fast = Output("BOOL")
    trips = Output("DINT", comment="how often the axis has become too fast")

    def start(self) -> None:
        """Forget all positions."""
        self._seen: deque[tuple[float, float]] = deque()

    def step(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002
        """Compare the position with that at the start of the window."""
        self._seen.append((time_s, self.axis))
        while self._seen[0][0] < time_s - WINDOW_S:
            self._seen.popleft()
        since_s, position = self._seen[0]
        if since_s < time_s:
            self.speed = abs(self.axis - position) / (time_s - since_s)
        too_fast = self.speed > self.limit
        self.trips += too_fast and not self.too_fast
        self.too_fast = too_fast
