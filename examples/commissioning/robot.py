"""A robot with six axes, which goes to the position that the PLC names."""

from __future__ import annotations

from shmio.simulation import Input, Model, Output, Parameter

POSITIONS = {
    1: (90.0, -90.0, 90.0, 0.0, 45.0, 0.0),  # home
    2: (180.0, -60.0, 112.0, 0.0, 38.0, 0.0),  # picks up
    3: (0.0, -60.0, 112.0, 0.0, 38.0, 0.0),  # puts down
}
AXES = [f"Axs{number}_Pos" for number in range(1, 7)]


class Robot(Model):
    """Moves all axes at once, so that they start and stop together."""

    speed = Parameter("LREAL", 75.0, unit="deg/s", limits=(1.0, 180.0), comment="of the axis with the longest way")
    to = Input("INT", 1, comment="position to go to")
    at = Output("INT", 1, comment="position reached; 0 while it moves")
    axes = Output(dict.fromkeys(AXES, "REAL"), dict(zip(AXES, POSITIONS[1], strict=True)), unit="deg")

    def step(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002
        """Move towards the position as far as the speed allows."""
        target = POSITIONS.get(self.to)
        if target is None:  # the PLC has not decided yet
            return
        now = list(self.axes.values())
        way = max(abs(end - begin) for begin, end in zip(now, target, strict=True))
        share = min(1.0, self.speed * dt_s / way) if way else 1.0
        self.axes = {axis: begin + share * (end - begin) for axis, begin, end in zip(AXES, now, target, strict=True)}
        self.at = self.to if share == 1.0 else 0
