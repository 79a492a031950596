"""The model of the A50 cell as an emulated controller's program: ``shmio.simulation.a50`` says what it does."""

from __future__ import annotations

from dataclasses import replace

from shmio.errors import ConfigError
from shmio.layout.model import Layout
from shmio.simulation import ModelRunner
from shmio.simulation.a50 import A50Cell


class A50:
    """The program of the cell's controller, and the plant."""

    period_ms = 10

    def __init__(self, layout: Layout) -> None:
        """Find the registers; ConfigError names one that the layout lacks or has as another type."""
        # The printed DB201 has a space for the underscore in some names.
        named = tuple(replace(register, path=register.path.replace(" ", "_")) for register in layout.registers)
        try:
            self._runner = ModelRunner(A50Cell, replace(layout, registers=named))
        except ConfigError as error:
            raise ConfigError(f"program a50: {str(error).removeprefix('layout: ')}") from None

    def step(self, time_s: float, frame: bytearray) -> None:
        """Put axes, inputs and outputs of this time into the frame."""
        self._runner.resume(bytes(frame))  # clients write what they please, outputs included
        frame[:] = self._runner.step(round(time_s * 1e9), self.period_ms * 1_000_000)
