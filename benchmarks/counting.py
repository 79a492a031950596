"""A model for the benchmarks: 100 single registers and an array of 100, all of which change with each step."""

from __future__ import annotations

from shmio.simulation import Model, Output

COUNT = 100


class Counting(Model):
    """Writes the number of steps into each register."""

    values = Output({f"r{index:02}": "LREAL" for index in range(COUNT)})
    row = Output(f"ARRAY[1..{COUNT}] OF LREAL")

    def start(self) -> None:
        self.count = 0

    def step(self, time_s: float, dt_s: float) -> None:  # noqa: ARG002  it knows no time
        self.count += 1
        self.values = {f"r{index:02}": float(self.count + index) for index in range(COUNT)}
        self.row = tuple(float(self.count + index) for index in range(COUNT))
