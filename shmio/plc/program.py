"""The base class of PLC programs."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, final

from shmio.errors import ModelError
from shmio.plc.blocks import FunctionBlock
from shmio.simulation.model import Model

MIN_PERIOD_MS = 1.0
MAX_PERIOD_MS = 60_000.0


class Program(Model):
    """Base class of PLC programs.

    A program declares its registers as a model does: :class:`~shmio.simulation.Input` for what it
    reads, :class:`~shmio.simulation.Output` for what it sets and can read back. Function blocks are
    declared in the class body, too. ``start`` runs once before the first scan.

    On an emulated controller, all registers are memory of the controller: clients may write any of
    them between two scans. A program is also a model: a source with ``connector = "simulation"``
    can run it without a controller, one scan a step.
    """

    period_ms: ClassVar[float] = 10.0
    """Time between two scans on an emulated controller, in ms."""

    state_modules = ("shmio.plc.blocks",)
    _now_ns: int = 0

    def __init_subclass__(cls, **keywords: object) -> None:
        """Check the declarations and the period when a subclass is created.

        Raises:
            ModelError: A declaration or the period is invalid. The message names the class.

        """
        super().__init_subclass__(**keywords)
        period_ms = cls.period_ms
        if not isinstance(period_ms, int | float) or not MIN_PERIOD_MS <= period_ms <= MAX_PERIOD_MS:
            limits = f"{MIN_PERIOD_MS:g} to {MAX_PERIOD_MS:g} ms"
            raise ModelError(f"program {cls.__qualname__}: period_ms: {period_ms!r} is not a number from {limits}")
        if "step" in cls.__dict__:
            raise ModelError(f"program {cls.__qualname__}: a program has no step(); rename it to scan()")
        for name, value in vars(cls).items():
            if isinstance(value, FunctionBlock) and hasattr(Program, name):
                raise ModelError(f"program {cls.__qualname__}: {name}: this name is reserved; rename the block")

    @final
    def step(self, time_s: float, dt_s: float) -> None:
        """Run one scan, after setting the time that the function blocks read."""
        self._now_ns = round(time_s * 1e9)
        self.scan(time_s, dt_s)

    @abstractmethod
    def scan(self, time_s: float, dt_s: float) -> None:
        """Read the inputs and set the outputs, as the main program of a controller does.

        Args:
            time_s: The program's time, in s.
            dt_s: The time since the last scan, in s; 0 in the first scan on an emulated controller.

        """
