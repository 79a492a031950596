"""An oven, as an FMU in Python."""

from __future__ import annotations

from typing import Any

from pythonfmu3 import Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability


class Oven(Fmi3Slave):  # type: ignore[misc]  # its library has no types
    """Heated by its power, and cooled by its loss."""

    def __init__(self, **keywords: Any) -> None:
        super().__init__(**keywords)
        self.time = self.power = 0.0
        self.temperature = 20.0
        self.loss = 0.1
        kinds, continuous = Fmi3Causality, Fmi3Variability.continuous
        self.register_variable(Float64("time", causality=kinds.independent, variability=continuous))
        self.register_variable(Float64("power", causality=kinds.input, variability=continuous, start=0.0))
        self.register_variable(Float64("loss", causality=kinds.parameter, variability=Fmi3Variability.tunable))
        self.register_variable(Float64("temperature", causality=kinds.output, variability=continuous))

    def do_step(self, current_time: float, step_size: float) -> bool:
        self.temperature += step_size * (self.power - self.loss * (self.temperature - 20.0))
        return True
