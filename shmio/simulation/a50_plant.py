"""What moves when in the A50 cell: the steps of a cycle, its actuators, and the paths of its axes.

Everything follows from the time in the cycle alone; ``a50`` makes signals of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import NamedTuple

from shmio.simulation.motion import Pose, Track

# Number and duration in s of each step, in order.
STEPS: Mapping[int, float] = {
    10: 4.0,  # trolley in
    20: 1.0,  # clamp it
    30: 2.0,  # close the door
    40: 8.0,  # Robot_825 loads test unit 1
    50: 1.5,  # its actuators take hold
    60: 8.0,  # Robot_850 loads test unit 2
    70: 1.5,  # its actuators take hold
    80: 12.0,  # test; Robot_800 fetches a frame
    90: 1.5,  # actuators let go
    100: 7.0,  # Robot_825 unloads unit 1
    110: 7.0,  # Robot_850 unloads unit 2
    120: 6.0,  # Robot_800 puts the frame on the trolley
    130: 2.0,  # open the door
    140: 1.0,  # release the trolley
    150: 4.0,  # trolley out
}
BEGINS = dict(zip(STEPS, accumulate(STEPS.values(), initial=0.0), strict=False))
CYCLE_S = sum(STEPS.values())
CONVEYING = {10, 150}


class Actuator(NamedTuple):
    """A pneumatic drive: one valve, two limit switches."""

    name: str
    travel_s: float
    spans: tuple[tuple[float, float], ...]
    """Times in a cycle at which the valve opens (the drive extends) and closes (it retracts)."""

    def valve(self, phase_s: float) -> bool:
        """Whether the valve is open."""
        return any(extend_s <= phase_s < retract_s for extend_s, retract_s in self.spans)

    def switches(self, phase_s: float) -> int:
        """Limit switches: bit 0 extended, bit 1 retracted; neither on the way."""
        travel_s = self.travel_s
        extended = any(extend_s + travel_s <= phase_s < retract_s for extend_s, retract_s in self.spans)
        away = any(extend_s <= phase_s < retract_s + travel_s for extend_s, retract_s in self.spans)
        return extended | (not away) << 1


_TROLLEY_HELD = ((BEGINS[20], BEGINS[140]),)
ACTUATORS = (
    Actuator("trolley clamp left", 0.6, _TROLLEY_HELD),
    Actuator("trolley clamp right", 0.7, _TROLLEY_HELD),
    Actuator("door", 1.8, ((BEGINS[30], BEGINS[130]),)),
    Actuator("test unit 1, clamp", 0.5, ((BEGINS[50], BEGINS[90] + 0.6),)),
    Actuator("test unit 1, coupling", 0.5, ((BEGINS[50] + 0.7, BEGINS[90]),)),
    Actuator("test unit 2, clamp", 0.5, ((BEGINS[70], BEGINS[90] + 0.6),)),
    Actuator("test unit 2, coupling", 0.5, ((BEGINS[70] + 0.7, BEGINS[90]),)),
    Actuator("gripper of Robot_800", 0.2, ((BEGINS[80] + 5.0, BEGINS[120] + 3.4),)),
    Actuator(
        "gripper of Robot_825",
        0.2,
        ((BEGINS[40] + 2.5, BEGINS[40] + 6.0), (BEGINS[100] + 2.2, BEGINS[100] + 5.3)),
    ),
    Actuator(
        "gripper of Robot_850",
        0.2,
        ((BEGINS[60] + 2.5, BEGINS[60] + 6.0), (BEGINS[110] + 2.2, BEGINS[110] + 5.3)),
    ),
)
GRIPPERS = slice(7, 10)  # the robots', in their order

# Degrees, as the printed limits of a KR 210's axes allow.
AXIS_LIMITS = ((-185.0, 185.0), (-140.0, -5.0), (-120.0, 168.0), (-350.0, 350.0), (-122.5, 122.5), (-350.0, 350.0))
HOME: Pose = (0.0, -90.0, 90.0, 0.0, 45.0, 0.0)
_OVER_RACK: Pose = (96.0, -78.0, 98.0, 12.0, 52.0, -18.0)
_AT_RACK: Pose = (96.0, -61.0, 112.0, 14.0, 40.0, -20.0)
_FRAME_OVER_TROLLEY: Pose = (-38.0, -72.0, 96.0, -15.0, 61.0, 34.0)
_FRAME_ON_TROLLEY: Pose = (-38.0, -54.0, 109.0, -17.0, 44.0, 36.0)
_OVER_TROLLEY: Pose = (41.0, -80.0, 101.0, 5.0, 55.0, -42.0)
_AT_TROLLEY: Pose = (41.0, -63.0, 118.0, 6.0, 37.0, -43.0)
_OVER_UNIT: Pose = (-64.0, -85.0, 104.0, -8.0, 58.0, 72.0)
_AT_UNIT: Pose = (-64.0, -69.0, 117.0, -9.0, 43.0, 74.0)


def _carry(begin_s: float, to: tuple[Pose, Pose], away: tuple[Pose, Pose], slow: float) -> list[tuple[float, Pose]]:
    """Keys of: from home to the part, hold it, to its place, let go, home. ``slow`` stretches the times."""
    at = ((0, HOME), (1.5, to[0]), (2.3, to[1]), (2.8, to[1]), (3.5, to[0]), (5.2, away[0]), (5.9, away[1]),
          (6.3, away[1]), (7.0, away[0]), (8.0, HOME))  # fmt: skip
    return [(begin_s + time_s * slow, pose) for time_s, pose in at]


def _transfers(load_s: float, unload_s: float) -> list[tuple[float, Pose]]:
    trolley, unit = (_OVER_TROLLEY, _AT_TROLLEY), (_OVER_UNIT, _AT_UNIT)
    return _carry(load_s, trolley, unit, 1.0) + _carry(unload_s, unit, trolley, 7 / 8)


ROBOTS: Mapping[str, Track] = {
    "Robot_800": Track(
        [
            (BEGINS[80] + 1.0, HOME),
            (BEGINS[80] + 3.5, _OVER_RACK),
            (BEGINS[80] + 4.8, _AT_RACK),
            (BEGINS[80] + 5.3, _AT_RACK),
            (BEGINS[80] + 6.5, _OVER_RACK),
            (BEGINS[80] + 9.5, HOME),
            (BEGINS[120], HOME),
            (BEGINS[120] + 1.8, _FRAME_OVER_TROLLEY),
            (BEGINS[120] + 3.2, _FRAME_ON_TROLLEY),
            (BEGINS[120] + 3.7, _FRAME_ON_TROLLEY),
            (BEGINS[120] + 4.6, _FRAME_OVER_TROLLEY),
            (BEGINS[120] + 6.0, HOME),
        ],
        CYCLE_S,
        breath=0.03,
    ),
    "Robot_825": Track(_transfers(BEGINS[40], BEGINS[100]), CYCLE_S, breath=0.03),
    "Robot_850": Track(_transfers(BEGINS[60], BEGINS[110]), CYCLE_S, breath=0.03),
}

# Millimetres: parked, up to the engine when it is clamped, three strokes under load, back.
_NC_STROKES = [(1.0, 180.0), (3.5, 320.0), (5.0, 240.0), (7.0, 350.0), (9.0, 210.0), (11.5, 180.0)]
NC_AXES: Mapping[str, Track] = {
    name: Track(
        [(BEGINS[clamp] + 0.5, (20.0,)), (BEGINS[clamp] + 1.5, (180.0,))]
        + [(BEGINS[80] + time_s, (position,)) for time_s, position in _NC_STROKES]
        + [(BEGINS[90] + 0.5, (180.0,)), (BEGINS[90] + 2.5, (20.0,))],
        CYCLE_S,
        breath=0.02,
    )
    for name, clamp in (("NCAchse1_Pos", 50), ("NCAchse2_Pos", 70))
}
