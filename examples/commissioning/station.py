"""The PLC program of test unit 1, as it will be written for the S7-1500."""

from __future__ import annotations

from shmio.plc import TON, Input, Output, Program

HOME, PICK_UP, PUT_DOWN = 1, 2, 3
IDLE, FETCH, LOAD, TEST, TAKE, UNLOAD = 0, 10, 20, 30, 40, 50
TOO_HOT = 90.0


class Station(Program):
    """Lets Robot_800 load a motor, tests it for six seconds, and lets Robot_825 unload it."""

    run = Input("BOOL", path="Inputs/Run")
    reset = Input("BOOL", path="Inputs/Reset")
    robot_800_at = Input("INT", path="Inputs/Robot_800_At")
    robot_825_at = Input("INT", path="Inputs/Robot_825_At")
    temperature = Input("REAL", path="Inputs/Temperature")

    robot_800_to = Output("INT", path="Outputs/Robot_800_To")
    robot_825_to = Output("INT", path="Outputs/Robot_825_To")
    drive = Output("BOOL", path="Outputs/Drive")
    cooling = Output("BOOL", path="Outputs/Cooling")
    alarm = Output("BOOL", path="Outputs/Alarm")
    number = Output("INT", path="Outputs/Step")
    tested = Output("DINT", path="Outputs/Tested")

    test_time = TON(6.0)

    def scan(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002  the timer has the time
        """Go to the next step if the present one is done, then set the outputs of the step."""
        tested = self.test_time(self.drive)
        free_800, free_825 = self.robot_800_at == HOME, self.robot_825_at == HOME
        if self.number == IDLE and self.run and free_800 and free_825:
            self.number = FETCH
        elif self.number == FETCH and self.robot_800_at == PICK_UP:
            self.number = LOAD
        elif self.number == LOAD and self.robot_800_at == PUT_DOWN:
            self.number = TEST
        elif self.number == TEST and tested:
            self.number = TAKE
        elif self.number == TAKE and self.robot_825_at == PICK_UP:
            self.number = UNLOAD
        elif self.number == UNLOAD and self.robot_825_at == PUT_DOWN:
            self.number = IDLE
            self.tested += 1

        if self.temperature > TOO_HOT:
            self.alarm = True
        elif self.reset:
            self.alarm = False
        self.robot_800_to = {FETCH: PICK_UP, LOAD: PUT_DOWN}.get(self.number, HOME)
        self.robot_825_to = {TAKE: PICK_UP, UNLOAD: PUT_DOWN}.get(self.number, HOME)
        self.drive = self.number == TEST and free_800 and not self.alarm
        self.cooling = self.temperature > (50.0 if self.cooling else 60.0)
