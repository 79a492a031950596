"""A model of the A50 cell: three robots, two engine test units, a conveyor and a rack.

Deliverable D6.5, section 5.1, describes the cell. All motion depends only on the time; the
constants in this module say what moves when. In a cycle, a trolley brings two engines and is
clamped. Robot_825 and Robot_850 carry the engines to the test units, where two actuators hold each
of them. The axes of the units run the test, while Robot_800 fetches a frame from the rack. The
robots carry the engines back and put the frame on the trolley, and the trolley leaves. Any client
that writes the commands below can pause the cell and move its actuators by hand.

The real cell's I/O assignment is not public. This one was made for shmio. It uses the first bytes
of ``Inputs`` and ``Outputs``; the model does not change the other bytes or the commands. Words are
big-endian. Bits of a byte are listed from the lowest.

======  ===========================================================================================================
Inputs  plant to controller
======  ===========================================================================================================
0       control voltage on, emergency stop released, fence closed, air pressure good, returned heartbeat
1       trolley at entry, at station, at exit; conveyor turns
2       position of the trolley in mm, UINT
4 - 6   Robot_800, Robot_825, Robot_850: ready, in motion, at home, part in gripper
8 - 10  limit switches of ``ACTUATORS`` in their order: two bits each, extended, retracted
12, 14  test units 1 and 2: torque in 0.1 Nm, INT
16, 18  test units 1 and 2: speed in 1/min, INT
======  ===========================================================================================================

=======  ==========================================================================================================
Outputs  controller to plant
=======  ==========================================================================================================
0        heartbeat (0.5 s on, 0.5 s off), automatic mode, cycle runs (off on hold), first step, test runs
1        conveyor on, green lamp, white lamp (trolley moves), yellow lamp (hold)
2        number of the step, UINT
4        cycles finished, UDINT
8, 9     valves of ``ACTUATORS`` in their order: one bit each
10 - 12  Robot_800, Robot_825, Robot_850: drives on, task runs, work space released
13       command: hold; all motion stops while bit 0 is set
14, 15   command: valves of ``ACTUATORS`` to open in every step; the drive reaches its end at once
16, 17   command: valves of ``ACTUATORS`` to close in every step; this overrides the command to open
=======  ==========================================================================================================
"""

from __future__ import annotations

import math
import struct
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Final, NamedTuple

from shmio.simulation.model import InOut, Model, Output

Pose = tuple[float, ...]

_BREATH_PERIOD_S = 2.2
_BREATH_SPREAD_S = 0.31  # difference between neighbouring axes, so that they do not move in phase


def smooth(u: float) -> float:
    """Return a smooth transition from 0 (u <= 0) to 1 (u >= 1) with slope 0 at both ends."""
    u = min(max(u, 0.0), 1.0)
    return u * u * (3 - 2 * u)


class Track:
    """A cyclic motion of several axes through key poses. All axes start and stop together.

    A slow sine of small amplitude is added to each position, like the play of a servo loop. So the
    value of an axis changes even while the axis rests.
    """

    def __init__(self, keys: Sequence[tuple[float, Pose]], cycle_s: float, breath: float) -> None:
        """Create the track.

        Args:
            keys: The key poses with their times in the cycle in s, in order. From the last pose,
                the axes move to the first pose of the next cycle.
            cycle_s: The length of the cycle in s.
            breath: The amplitude of the sine, in the unit of the axes.

        """
        first_s, first = keys[0]
        self._cycle_s = cycle_s
        self._times = [time_s for time_s, _ in keys] + [first_s + cycle_s]
        self._poses = [pose for _, pose in keys] + [first]
        self._breath = breath

    def rest(self, time_s: float) -> Pose | None:
        """Return the key pose in which the axes rest at a time in s; None if they are moving then."""
        index, _ = self._place(time_s)
        return self._poses[index] if self._poses[index] == self._poses[index + 1] else None

    def pose(self, time_s: float) -> Pose:
        """Return the positions of all axes at a time in s."""
        index, u = self._place(time_s)
        share = smooth(u)
        return tuple(
            start + (end - start) * share + self._sine(time_s, axis)
            for axis, (start, end) in enumerate(zip(self._poses[index], self._poses[index + 1], strict=True))
        )

    def _place(self, time_s: float) -> tuple[int, float]:
        """Return the index of the last key pose, and the progress to the next pose, from 0 to 1."""
        phase_s = (time_s - self._times[0]) % self._cycle_s + self._times[0]
        index = min(bisect_right(self._times, phase_s), len(self._times) - 1) - 1
        begun_s, ends_s = self._times[index], self._times[index + 1]
        return index, (phase_s - begun_s) / (ends_s - begun_s)

    def _sine(self, time_s: float, axis: int) -> float:
        return self._breath * math.sin(2 * math.pi * time_s / (_BREATH_PERIOD_S + axis * _BREATH_SPREAD_S))


# Duration in s of each step by its number, in order.
STEPS: Mapping[int, float] = {
    10: 4.0,  # trolley in
    20: 1.0,  # clamp it
    30: 2.0,  # close the door
    40: 8.0,  # Robot_825 loads test unit 1
    50: 1.5,  # its actuators grip
    60: 8.0,  # Robot_850 loads test unit 2
    70: 1.5,  # its actuators grip
    80: 12.0,  # test; Robot_800 fetches a frame
    90: 1.5,  # actuators release
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
    """A pneumatic drive with one valve and two limit switches."""

    name: str
    travel_s: float
    spans: tuple[tuple[float, float], ...]
    """Pairs (start, stop) of times in a cycle, in s: the valve is open from start to stop and extends the drive."""

    def valve(self, phase_s: float) -> bool:
        """Return whether the valve is open at ``phase_s``, the time in the cycle in s."""
        return any(extend_s <= phase_s < retract_s for extend_s, retract_s in self.spans)

    def switches(self, phase_s: float) -> int:
        """Return the limit switches at ``phase_s``, the time in the cycle in s: bit 0 extended, bit 1 retracted.

        Both bits are 0 while the drive moves.
        """
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
GRIPPERS = slice(7, 10)  # the actuators of the robots, in the order of ROBOTS

# In degrees, from the data sheet of a KR 210.
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
    """Return the key poses of a transfer: pick up the part, put it down, return home.

    ``slow`` multiplies the duration of each motion.
    """
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

# In mm: parked, up to the clamped engine, three strokes under load, back.
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


_INPUTS = struct.Struct("> BB H BBBx 3sx hh hh")
_OUTPUTS = struct.Struct("> BB H I 2s BBB")
_ORDERS = struct.Struct("< B HH")  # after the outputs; of two bytes, the first has the lower bits
_AXES: Final = {f"Axs{axis}_Pos": "REAL" for axis in range(1, 7)}


class _CellState(NamedTuple):
    time_s: float
    phase_s: float
    """Time in the cell's cycle, in s. It stands still while the cell is paused."""
    cycles: int
    step: int
    hold: bool
    rests: list[Pose | None]
    valves: list[bool]
    switches: int


class A50Cell(Model):
    """A model of the cell and of its controller's program, with the signals of DB201.

    The model can use the layout that it declares, or the layout of ``db201.db``.
    """

    inputs = InOut("ARRAY[0..999] OF BYTE", path="Inputs", comment="plant to controller")
    outputs = InOut("ARRAY[0..1099] OF BYTE", path="Outputs", comment="controller to plant; orders to the controller")
    nc_axis_1 = Output("REAL", path="NCAchse1_Pos", unit="mm", comment="of test unit 1")
    nc_axis_2 = Output("REAL", path="NCAchse2_Pos", unit="mm", comment="of test unit 2")
    robot_800 = Output(_AXES, path="Robot_800", unit="deg")
    robot_825 = Output(_AXES, path="Robot_825", unit="deg")
    robot_850 = Output(_AXES, path="Robot_850", unit="deg")

    def start(self) -> None:
        """Start the first cycle."""
        self._held_s = 0.0
        self._cell_s: float | None = None  # time of the cell in s, which stops while the cell is paused

    def step(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002  everything depends only on the time
        """Compute the axes, inputs and outputs at ``time_s``.

        Bytes of ``Inputs`` and ``Outputs`` that the model does not compute keep the values that
        clients wrote.
        """
        inputs, outputs = self.inputs.commanded, self.outputs.commanded
        hold, opened, closed = _ORDERS.unpack_from(outputs, _OUTPUTS.size)
        hold &= 1
        if hold and self._cell_s is not None:
            self._held_s = time_s - self._cell_s
        else:
            self._cell_s = time_s - self._held_s
        cell_s = self._cell_s
        self._move(cell_s)
        phase_s = cell_s % CYCLE_S
        drives = [
            _drive(actuator, phase_s, opened >> place & 1, closed >> place & 1)
            for place, actuator in enumerate(ACTUATORS)
        ]
        now = _CellState(
            time_s=time_s,
            phase_s=phase_s,
            cycles=int(cell_s // CYCLE_S) & 0xFFFF_FFFF,
            step=max(number for number, begin_s in BEGINS.items() if begin_s <= phase_s),
            hold=bool(hold),
            rests=[track.rest(cell_s) for track in ROBOTS.values()],
            valves=[valve for valve, _ in drives],
            switches=sum(switches << 2 * place for place, (_, switches) in enumerate(drives)),
        )
        self.inputs.shown = _inputs(now) + inputs[_INPUTS.size :]
        self.outputs.shown = _outputs(now) + outputs[_OUTPUTS.size :]

    def _move(self, cell_s: float) -> None:
        poses = (dict(zip(_AXES, track.pose(cell_s), strict=True)) for track in ROBOTS.values())
        self.robot_800, self.robot_825, self.robot_850 = poses
        (self.nc_axis_1,), (self.nc_axis_2,) = (track.pose(cell_s) for track in NC_AXES.values())


def _inputs(now: _CellState) -> bytes:
    heartbeat = _beat(now.time_s - 0.04)  # the plant returns it with a delay
    phase_s = now.phase_s
    trolley_mm = 3000 * (smooth(phase_s / STEPS[10]) + smooth((phase_s - BEGINS[150]) / STEPS[150]))
    conveying = now.step in CONVEYING and not now.hold
    (torque_1, speed_1), (torque_2, speed_2) = (_load(phase_s - BEGINS[80], scale) for scale in (1.0, 0.93))
    return _INPUTS.pack(
        _bits(True, True, True, True, heartbeat),
        _bits(trolley_mm < 50, abs(trolley_mm - 3000) < 50, trolley_mm > 5950, conveying),
        round(trolley_mm),
        *(
            _bits(True, rest is None and not now.hold, rest == HOME, gripper)
            for rest, gripper in zip(now.rests, now.valves[GRIPPERS], strict=True)
        ),
        now.switches.to_bytes(3, "little"),
        torque_1,
        torque_2,
        speed_1,
        speed_2,
    )


def _outputs(now: _CellState) -> bytes:
    conveying = now.step in CONVEYING
    return _OUTPUTS.pack(
        _bits(_beat(now.time_s), True, not now.hold, now.step == 10, now.step == 80),
        _bits(conveying and not now.hold, not conveying and not now.hold, conveying, now.hold),
        now.step,
        now.cycles,
        _bits(*now.valves).to_bytes(2, "little"),
        *(_bits(True, rest != HOME, rest == HOME) for rest in now.rests),
    )


def _beat(time_s: float) -> bool:
    return round(time_s * 1000) % 1000 < 500


def _drive(actuator: Actuator, phase_s: float, opened: int, closed: int) -> tuple[bool, int]:
    """Return the state of the valve and the limit switches. A command moves the drive at once."""
    if closed:
        return False, 0b10
    if opened:
        return True, 0b01
    return actuator.valve(phase_s), actuator.switches(phase_s)


def _bits(*flags: bool) -> int:
    return sum(flag << place for place, flag in enumerate(flags))


def _load(test_s: float, scale: float) -> tuple[int, int]:
    """Return torque in 0.1 Nm and speed in 1/min of a test unit at a time in the test."""
    duration_s = STEPS[80]
    share = smooth(test_s / 2) * smooth((duration_s - test_s) / 2)
    torque_nm = share * (85 + 30 * math.sin(2 * math.pi * test_s / 3))
    return round(torque_nm * scale * 10), round(share * 3000 * scale)
