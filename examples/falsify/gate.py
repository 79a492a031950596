"""The gate of the A50 cell: the door, the arm of Robot_825 in front of it, and the interlock of both.

The arm goes through the path of the door. So the interlock has two rules. The arm stops while the
door moves, unless it has passed the last point at which it can still stop. The door starts to move
only while the arm can still stop.

The program has a fault, as it happens where two controllers exchange signals: the door's
controller sees the arm's signal ``scans_late`` scans late. If the door gets the command to move
within these 40 ms after the arm has passed the point, both move.
"""

from __future__ import annotations

from collections import deque

from shmio.simulation import Input, Model, Output, Parameter

PATH_MM = 800.0
"""Where the path of the door begins, seen from the arm's home position."""
POINT_MM = 700.0
"""The last point at which the arm can still stop before the path."""
END_MM = 1200.0
BRAKE_MM_S2 = 800.0
TRAVEL_S = 1.8
"""The time in which the door opens or closes."""


class Gate(Model):
    """Moves door and arm as their commands and the interlock say."""

    valve = Input("BOOL", comment="command: close the door")
    task = Input("BOOL", comment="command: the arm goes through the door, and back when it ends")
    door = Output("LREAL", comment="0 open, 1 closed")
    door_moves = Output("BOOL")
    arm = Output("LREAL", unit="mm", comment="distance from the home position")
    arm_passed = Output("BOOL", comment="the arm can no longer stop before the path")
    clearance = Output("LREAL", initial=PATH_MM, unit="mm", comment="between the arm and a moving door")
    arm_speed = Parameter("LREAL", initial=250.0, unit="mm/s", limits=(50.0, 1000.0))
    scans_late = Parameter("INT", initial=2, limits=(0.0, 50.0), comment="the fault; 0 repairs it")

    def start(self) -> None:
        """Begin with an open door, and the arm at home."""
        self._speed = 0.0
        self._sent = deque([False] * self.scans_late)

    def step(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002
        """Run a scan of the interlock, and move door and arm."""
        self._sent.append(self.arm_passed)
        arm_passed = self._sent.popleft()  # as the door's controller sees it
        door, target = float(self.door), 1.0 if self.valve else 0.0
        if door == target:
            self.door_moves = False
        elif self.door_moves or not arm_passed:
            self.door_moves = True
            change = dt_s / TRAVEL_S
            self.door = min(door + change, target) if target > door else max(door - change, target)
        stop = self.door_moves and not self.arm_passed
        wanted = 0.0 if stop else self.arm_speed if self.task else -self.arm_speed
        change = BRAKE_MM_S2 * dt_s
        self._speed += min(max(wanted - self._speed, -change), change)
        arm = min(max(self.arm + self._speed * dt_s, 0.0), END_MM)
        if arm in (0.0, END_MM):
            self._speed = 0.0
        self.arm = arm
        self.arm_passed = arm > POINT_MM and (self.arm_passed or not stop)
        self.clearance = max(PATH_MM - arm, 0.0) if self.door_moves else PATH_MM
