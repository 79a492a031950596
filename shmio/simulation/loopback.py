"""The loop-back model: readers see a value one step after a client has written it.

Clients of SimlogAPI use these registers in their tests.
"""

from __future__ import annotations

from typing import Final

from shmio.simulation.model import InOut, Model

POSITION: Final = "LREAL"


class Loopback(Model):
    """A model that shows the values written to four joint positions and a safety zone."""

    r3200_link1 = InOut(POSITION, path="joints/R3200/Link1/R/position")
    kuka_j1 = InOut(POSITION, path="joints/Kuka.j1/R")
    kuka_j2 = InOut(POSITION, path="joints/Kuka.j2/R")
    r3_l2 = InOut(POSITION, path="joints/R3.L2/R")
    zone_1 = InOut("SafetyZone", {"zone": "Z1"}, path="safetyzones/Z1")

    def step(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002  nothing depends on the time
        """Show the values that clients wrote before this step."""
        for ends in (self.r3200_link1, self.kuka_j1, self.kuka_j2, self.r3_l2, self.zone_1):
            ends.shown = ends.commanded
