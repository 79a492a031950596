"""The control of the cell's door, before it goes into the PLC; and the door, which follows it."""

from __future__ import annotations

from shmio.plc import TON, Input, Output, Program
from shmio.simulation import Parameter

PASSED_MM = 1550  # the trolley has passed the door
TRAVEL_S = 1.8  # the time in which the door closes


class Door(Program):
    """Closes the door half a second after the trolley has arrived at the station."""

    at_station = Input("BOOL", comment="switch at the station")
    position_high = Input("BYTE", comment="position of the trolley in mm, high byte")
    position_low = Input("BYTE", comment="low byte")
    close = Output("BOOL")
    closed = Output("LREAL", comment="0 open, 1 closed")
    clearance = Output("LREAL", PASSED_MM, unit="mm", comment="between a closing door and the trolley")
    checked = Parameter("BOOL", False, comment="close only if the position agrees with the switch")

    arrived = TON(0.5)

    def scan(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002
        """Decide whether to close, and move the door."""
        position_mm = 256 * self.position_high + self.position_low
        there = self.at_station and (position_mm > 2900 or not self.checked)
        self.close = self.arrived(there)
        way = dt_s / TRAVEL_S if self.close else -dt_s / TRAVEL_S
        closed = min(max(self.closed + way, 0.0), 1.0)
        self.closed = closed
        self.clearance = float(position_mm - PASSED_MM if closed > 0 else PASSED_MM)
