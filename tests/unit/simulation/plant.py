"""A model that uses every kind of declaration."""

from __future__ import annotations

from shmio.simulation import InOut, Input, Model, Output, Parameter


class Belt(Model):
    """A belt with a light barrier, and a drive that follows its set point."""

    length_m = Parameter("LREAL", 2.0, unit="m")
    noise_m = Parameter("LREAL", 0.0)
    speed = Input("REAL", 0.5, unit="m/s", comment="of the belt")
    stop = Input("BOOL")
    position = Output("LREAL", unit="m")
    barriers = Output("ARRAY[1..3] OF BOOL")
    label = Output("STRING[12]", "empty")
    drive = InOut("INT", 7, path="drives/main")
    raw = InOut("ARRAY[0..3] OF BYTE", [1, 2, 3, 4])
    box = Output({"width": "REAL", "corners": "ARRAY[0..1] OF INT"}, {"width": 0.25}, path="parts/box")

    def step(self, time_s: float, dt_s: float) -> None:
        if not self.stop:
            self.position = (self.position + self.speed * dt_s) % self.length_m + self.noise_m * self.random.random()
        third = int(3 * self.position / self.length_m) % 3
        self.barriers = [place == third for place in range(3)]
        self.label = f"{time_s:.2f} s"
        self.drive.shown = self.drive.commanded + 1
        self.raw.shown = bytes(reversed(self.raw.commanded))
        self.box = {"corners": (third, -third)}
