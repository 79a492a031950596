"""The A50 cell (D6.5, section 5.1): three robots, two engine test units, a conveyor for trolleys, a rack of frames.

What moves when is told by the tables of ``a50_plant`` and follows from the time alone. A cycle: a trolley brings two
engines and is clamped; Robot_825 and Robot_850 carry them to the test units, whose two actuators each take hold; the
units' axes run the test while Robot_800 fetches a frame from the rack; the engines go back, the frame is put on the
trolley, the trolley leaves. An operator, which is whoever writes the orders below, can hold the cell and drive its
actuators by hand.

The real cell's I/O assignment is not public. This one is shmio's own, in the first bytes of ``Inputs`` and
``Outputs``; what follows, and the orders, are left as clients wrote them. Words are big-endian, bits of a byte count
from the lowest.

======  ===========================================================================================================
Inputs  plant to controller
======  ===========================================================================================================
0       control voltage on, emergency stop released, fence closed, air pressure good, heartbeat as returned
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
13       order: hold, which stops all motion where it is until it is taken back
14, 15   order: valves of ``ACTUATORS`` to be open whatever the step says; the drive is at its end at once
16, 17   order: valves to be closed, likewise; it wins over the one before
=======  ==========================================================================================================
"""

from __future__ import annotations

import math
import struct
from typing import Final, NamedTuple

from shmio.simulation.a50_plant import (
    ACTUATORS,
    BEGINS,
    CONVEYING,
    CYCLE_S,
    GRIPPERS,
    HOME,
    NC_AXES,
    ROBOTS,
    STEPS,
    Actuator,
)
from shmio.simulation.declarations import InOut, Output
from shmio.simulation.model import Model
from shmio.simulation.motion import Pose, smooth

_INPUTS = struct.Struct("> BB H BBBx 3sx hh hh")
_OUTPUTS = struct.Struct("> BB H I 2s BBB")
_ORDERS = struct.Struct("< B HH")  # behind the outputs; of two bytes, the first has the lower bits
_AXES: Final = {f"Axs{axis}_Pos": "REAL" for axis in range(1, 7)}


class _Moment(NamedTuple):
    time_s: float
    phase_s: float
    """Time in the cell's cycle, which stands still on hold."""
    cycles: int
    step: int
    hold: bool
    rests: list[Pose | None]
    valves: list[bool]
    switches: int


class A50Cell(Model):
    """The cell, its controller's program included: the signals of DB201, on a layout of its own or on ``db201.db``."""

    inputs = InOut("ARRAY[0..999] OF BYTE", path="Inputs", comment="plant to controller")
    outputs = InOut("ARRAY[0..1099] OF BYTE", path="Outputs", comment="controller to plant; orders to the controller")
    nc_axis_1 = Output("REAL", path="NCAchse1_Pos", unit="mm", comment="of test unit 1")
    nc_axis_2 = Output("REAL", path="NCAchse2_Pos", unit="mm", comment="of test unit 2")
    robot_800 = Output(_AXES, path="Robot_800", unit="deg")
    robot_825 = Output(_AXES, path="Robot_825", unit="deg")
    robot_850 = Output(_AXES, path="Robot_850", unit="deg")

    def start(self) -> None:
        """Begin a cycle."""
        self._held_s = 0.0
        self._cell_s: float | None = None  # the cell's own time, which stands still on hold

    def step(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002  all follows from the time
        """Put axes, inputs and outputs of this time in their places; what follows them stays as it was written."""
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
        now = _Moment(
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


def _inputs(now: _Moment) -> bytes:
    heartbeat = _beat(now.time_s - 0.04)  # comes back after the plant's own delay
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


def _outputs(now: _Moment) -> bytes:
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
    """Valve and limit switches; an order puts the drive at its end at once, for nobody knows when it was given."""
    if closed:
        return False, 0b10
    if opened:
        return True, 0b01
    return actuator.valve(phase_s), actuator.switches(phase_s)


def _bits(*flags: bool) -> int:
    return sum(flag << place for place, flag in enumerate(flags))


def _load(test_s: float, scale: float) -> tuple[int, int]:
    """Torque in 0.1 Nm and speed in 1/min of a test unit: run up, hold under a swelling load, run down."""
    duration_s = STEPS[80]
    share = smooth(test_s / 2) * smooth((duration_s - test_s) / 2)
    torque_nm = share * (85 + 30 * math.sin(2 * math.pi * test_s / 3))
    return round(torque_nm * scale * 10), round(share * 3000 * scale)
